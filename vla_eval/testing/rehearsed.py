"""What a rehearsal measured, and what was estimated before. Knows no models."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

EXTRA_SHARE, EXTRA_BYTES = 1.15, 2e9


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimated:
    """What a model's shapes say before it is made; what is not known is None or not among the stages."""

    parameters: int
    trained: int | None
    bytes: int
    peak_rss_bytes: Mapping[str, int]
    peak_device_bytes: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rehearsed:
    """What was measured; memory and seconds are by stage."""

    # `recipe`, `kind`, `dtype`, `device`: what was rehearsed; a folder's path where it was a checkpoint
    recipe: str
    kind: str
    dtype: str
    device: str
    parameters: int
    trained: int | None  # what the recipe trains of it, adapters included; None for a checkpoint
    bytes: int
    peak_rss_bytes: Mapping[str, int]
    peak_device_bytes: int | None
    seconds: Mapping[str, float]
    inferences: Mapping[int, Any]  # by episodes in a pass, see `InferenceRate`
    before_bytes: int  # memory of the process before anything was made: torch, transformers, lerobot
    limit_bytes: int  # 1.15 × the weights + 2 GB, which loading and acting must keep
    estimated: Estimated

    @property
    def is_within_limit(self) -> bool:
        """Whether loading and acting took no more memory than allowed."""
        return max(self.peak_rss_bytes["load"], self.peak_rss_bytes["act"]) <= self.limit_bytes

    def lines(self) -> list[str]:
        """Return lines for a person."""
        took, before = self.seconds, self.estimated
        verdict = "within" if self.is_within_limit else "ABOVE"
        on_device = (
            ""
            if self.peak_device_bytes is None
            else f"; most on the device {_gb(self.peak_device_bytes)}{_estimated(before.peak_device_bytes)}"
        )
        title = f"{self.recipe} ({self.kind}, {self.dtype}, {self.device})"
        parameters = f"parameters   {self.parameters:,} (estimated {before.parameters:,})"
        on_disk = f"on disk      {_gb(self.bytes)}{_estimated(before.bytes)}"
        if self.trained is not None:
            title += ": random weights: the actions mean nothing"
            parameters += f", of which the recipe trains {self.trained:,} (estimated {before.trained:,})"
            on_disk += f", written in {took['write']:.1f} s, {self._peak('write')}"
        return [
            title,
            parameters,
            on_disk,
            f"loading      {took['load']:.1f} s, {self._peak('load')}",
            f"inference    first {took['first_inference']:.2f} s, second {took['second_inference']:.2f} s, "
            f"{self._peak('act')}{on_device}",
            f"limit        {_gb(self.limit_bytes)} = {EXTRA_SHARE} × weights + {_gb(EXTRA_BYTES)}: {verdict} "
            f"it; {_gb(self.before_bytes)} were taken before anything was made",
        ]

    def _peak(self, stage: str) -> str:
        estimate = _estimated(self.estimated.peak_rss_bytes.get(stage))
        return f"peak memory {_gb(self.peak_rss_bytes[stage])}{estimate}"

    def data(self) -> dict[str, Any]:  # Any: plain data
        """Return it as JSON holds it."""
        return {**asdict(self), "is_within_limit": self.is_within_limit}


def limit_bytes(n_bytes: int) -> int:
    """Return how much memory a process may take that loads so many bytes of weights."""
    return int(EXTRA_SHARE * n_bytes + EXTRA_BYTES)


def _estimated(n_bytes: int | None) -> str:
    return "" if n_bytes is None else f" (estimated {_gb(n_bytes)})"


def _gb(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.{2 if n_bytes < 10e9 else 1}f} GB"
