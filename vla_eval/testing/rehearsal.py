"""Rehearse a recipe at its true size with random weights: write a checkpoint, load it strictly, act.

Or a checkpoint that is there: load it, act.

What is measured is memory, disk and time; the actions mean nothing. Weights are made part by part, so that
they are in memory once, when they are loaded.
"""

import contextlib
import math
import resource
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow, Policy
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError
from vla_eval.features import CAMERA_KEYS
from vla_eval.policies.checkpoint import ADAPTER_CONFIG_FILE, WEIGHTS_FILE, find_checkpoint
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot import make_lerobot
from vla_eval.policies.lerobot_loading import (
    LoadOptions,
    load_checkpoint,
    make_unfilled_policy,
    read_config,
)
from vla_eval.policies.lerobot_types import history
from vla_eval.policies.verify import random_batch
from vla_eval.policies.weight_file import WeightFile
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.testing.random_checkpoint import TASK, built_tiny, stand_in_config, write_checkpoint
from vla_eval.training.estimate import unfilled_model
from vla_eval.training.job import load_finetune_recipe

N_STEPS = 20
EXTRA_SHARE, EXTRA_BYTES = 1.15, 2e9
MEMINFO, CLEAR_REFS, STATUS = (Path("/proc") / name for name in ("meminfo", "self/clear_refs", "self/status"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rehearsed:
    """What was measured.

    Attributes:
        recipe, kind, dtype, device: what was rehearsed; a folder's path where it was a checkpoint.
        parameters: of the model.
        trained: what the recipe trains, adapters included; None for a checkpoint.
        bytes: of the file of weights.
        peak_rss_bytes: most memory of the process, by stage: `write` (a recipe's only), `load`, `act`.
        peak_device_bytes: most memory on the GPU; None on a CPU.
        seconds: by stage: `write` (a recipe's only), `load`, `first_inference`, `second_inference`.
        inferences_per_second: episodes in a forward pass -> inferences; empty if it was not asked for.
        before_bytes: memory of the process before anything was made: torch, transformers, lerobot.
        limit_bytes: 1.15 × the weights + 2 GB, which loading and acting must keep.
    """

    recipe: str
    kind: str
    dtype: str
    device: str
    parameters: int
    trained: int | None
    bytes: int
    peak_rss_bytes: dict[str, int]
    peak_device_bytes: int | None
    seconds: dict[str, float]
    inferences_per_second: dict[int, float]
    before_bytes: int
    limit_bytes: int

    @property
    def is_within_limit(self) -> bool:
        """Whether loading and acting took no more memory than allowed."""
        return max(self.peak_rss_bytes["load"], self.peak_rss_bytes["act"]) <= self.limit_bytes

    def lines(self) -> list[str]:
        """Return lines for a person."""
        peak, took = self.peak_rss_bytes, self.seconds
        verdict = "within" if self.is_within_limit else "ABOVE"
        on_device = "" if self.peak_device_bytes is None else f", on the device {_gb(self.peak_device_bytes)}"
        title = f"{self.recipe} ({self.kind}, {self.dtype}, {self.device})"
        parameters, on_disk = f"parameters   {self.parameters:,}", f"on disk      {_gb(self.bytes)}"
        if self.trained is not None:
            title += ": random weights: the actions mean nothing"
            parameters += f", of which the recipe trains {self.trained:,}"
            on_disk += f", written in {took['write']:.1f} s, peak memory {_gb(peak['write'])}"
        return [
            title,
            parameters,
            on_disk,
            f"loading      {took['load']:.1f} s, peak memory {_gb(peak['load'])}{on_device}",
            f"inference    first {took['first_inference']:.2f} s, second {took['second_inference']:.2f} s, "
            f"peak memory {_gb(peak['act'])}",
            f"limit        {_gb(self.limit_bytes)} = {EXTRA_SHARE} × weights + {_gb(EXTRA_BYTES)}: {verdict} "
            f"it; {_gb(self.before_bytes)} were taken before anything was made",
        ]

    def data(self) -> dict[str, Any]:  # Any: plain data
        """Return it as JSON holds it."""
        return {**asdict(self), "is_within_limit": self.is_within_limit}


@dataclass(frozen=True, slots=True, kw_only=True)
class RehearsalOptions:
    """How to rehearse.

    Attributes:
        folder: where a recipe's checkpoint is written; it is removed afterwards.
        dtype: `float32` or `bfloat16`, for policies with such a setting; None: the recipe's or as saved.
        device: `cpu`, `cuda` …
        tiny: build the π0 family and SmolVLA in their tiny form, for tests.
    """

    folder: Path
    dtype: str | None = None
    device: str = "cpu"
    tiny: bool = False


def rehearse(name: str, options: RehearsalOptions, *, batches: Sequence[int] = ()) -> Rehearsed:
    """Rehearse a recipe.

    Args:
        name: of the recipe, which has a section `finetune`.
        options: see there.
        batches: also measure inferences per second of so many episodes in one forward pass.

    Raises:
        CheckpointError: the folder exists, or memory is too small.
        RecipeError: the recipe has nothing to train.
    """
    if options.folder.exists():
        raise CheckpointError(f"{options.folder} exists already. Name another folder with --out.")
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none")).value
    before = peak_rss_bytes()
    options.folder.mkdir(parents=True)
    try:
        with built_tiny(recipe.type, tiny=options.tiny):
            return _rehearse(name, recipe, options, before, batches)
    finally:
        shutil.rmtree(options.folder)


def rehearse_checkpoint(path: Path, options: RehearsalOptions, *, batches: Sequence[int] = ()) -> Rehearsed:
    """Load a checkpoint that is there, and let it act; its weights are those of its files.

    Args:
        path: a LeRobot checkpoint, or a run.
        options: `device` and `dtype` are used.
        batches: see `rehearse`.

    Raises:
        CheckpointError: it is incomplete, or memory is too small.
    """
    before, folder = peak_rss_bytes(), find_checkpoint(path)
    if (folder / ADAPTER_CONFIG_FILE).is_file():
        raise CheckpointError(
            f"{folder}: expected whole weights, found a LoRA adapter. Merge it first: "
            f"mikasa-vla checkpoint merge {path} --out DIR"
        )
    config = read_config(folder, LoadOptions(device=options.device, dtype=options.dtype))
    n_parameters = sum(x.numel() for x in WeightFile(folder / WEIGHTS_FILE).described().values())
    written = _Written(n_parameters=n_parameters, trained=None, peaks={}, seconds={})
    return _measured(str(path), folder, config, options, written, before, batches)


def _rehearse(
    name: str, recipe: FinetuneRecipe, options: RehearsalOptions, before: int, batches: Sequence[int]
) -> Rehearsed:
    config, tokenizer = stand_in_config(recipe, options.folder, dtype=options.dtype, tiny=options.tiny)
    trained = sum(x.numel() for x in unfilled_model(config, recipe).parameters() if x.requires_grad)
    config.pretrained_path = None
    policy = make_unfilled_policy(config)
    folder = options.folder / "model"
    folder.mkdir()
    reset_peak()
    started = time.perf_counter()
    write_checkpoint(folder, config, policy, tokenizer)
    written = _Written(
        n_parameters=sum(x.numel() for x in policy.parameters()),
        trained=trained,
        seconds={"write": time.perf_counter() - started},
        peaks={"write": peak_rss_bytes()},
    )
    del policy
    return _measured(name, folder, config, options, written, before, batches)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Written:
    n_parameters: int
    trained: int | None
    peaks: dict[str, int]
    seconds: dict[str, float]


def _measured(
    name: str,
    folder: Path,
    config: Any,
    options: RehearsalOptions,
    written: _Written,
    before: int,
    batches: Sequence[int],
) -> Rehearsed:
    n_bytes = (folder / WEIGHTS_FILE).stat().st_size
    limit = int(EXTRA_SHARE * n_bytes + EXTRA_BYTES)
    _check_memory(limit, options.device)
    acted = _load_and_act(folder, config, options, batches)
    return Rehearsed(
        recipe=name,
        kind=config.type,
        dtype=str(getattr(config, "dtype", "float32")),
        device=options.device,
        parameters=written.n_parameters,
        trained=written.trained,
        bytes=n_bytes,
        peak_rss_bytes={**written.peaks, **acted.peaks},
        peak_device_bytes=torch.cuda.max_memory_allocated() if options.device != "cpu" else None,
        seconds={**written.seconds, **acted.seconds},
        inferences_per_second=acted.inferences_per_second,
        before_bytes=before,
        limit_bytes=limit,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Acted:
    peaks: dict[str, int]
    seconds: dict[str, float]
    inferences_per_second: dict[int, float]


class _Timed:
    """A policy whose inferences are timed."""

    def __init__(self, policy: Any) -> None:
        self._policy, self.spec = policy, policy.spec
        self.seconds: list[float] = []

    def reset(self, episodes: Any) -> None:
        self._policy.reset(episodes)

    def act(self, window: ObservationWindow) -> ActionChunk:
        started = time.perf_counter()
        chunk: ActionChunk = self._policy.act(window)
        self.seconds.append(time.perf_counter() - started)
        return chunk


def _load_and_act(folder: Path, config: Any, options: RehearsalOptions, batches: Sequence[int]) -> _Acted:
    """Load through the strict door of an evaluation, and run one episode on the fake simulator."""
    env = make_env(
        EnvSettings(
            task=TASK, kwargs={"horizon_steps": N_STEPS}, simulator="fake", cameras=tuple(CAMERA_KEYS)
        )
    )
    n_action_steps = int(getattr(config, "n_action_steps", 1))
    chunking = ChunkingSpec(n_action_steps=min(n_action_steps, N_STEPS // 2))
    context = PolicyContext(name="rehearsal", env=env.spec, chunking=chunking, n_candidates=3)
    cameras = _cameras(config)
    reset_peak()
    started = time.perf_counter()
    dtype: Any = options.dtype
    loaded = make_lerobot(
        context, checkpoint=str(folder), device=options.device, dtype=dtype, cameras=cameras, batch=False
    )
    seconds = {"load": time.perf_counter() - started}
    peaks = {"load": peak_rss_bytes()}
    reset_peak()
    timed: Any = _Timed(loaded)
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="pick the cube", horizon_steps=N_STEPS)
    policy: Policy = timed
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
    assert record.error is None  # else it was raised
    peaks["act"] = peak_rss_bytes()
    seconds |= {"first_inference": timed.seconds[0], "second_inference": timed.seconds[1]}
    del loaded, timed, policy
    rates = _rates(folder, options.device, batches) if batches else {}
    return _Acted(peaks=peaks, seconds=seconds, inferences_per_second=rates)


@torch.no_grad()
def _rates(folder: Path, device: str, batches: Sequence[int]) -> dict[int, float]:
    """Return inferences per second by the number of episodes in one forward pass."""
    loaded = load_checkpoint(folder, LoadOptions(device=device))
    one = random_batch(loaded.config, history(loaded.config), torch.Generator().manual_seed(0))
    rates: dict[int, float] = {}
    for n in batches:
        batch = {key: x.repeat_interleave(n, 0) if isinstance(x, Tensor) else x * n for key, x in one.items()}
        for _ in range(2):  # the first one fills caches
            started = time.perf_counter()
            chunk = loaded.policy.predict_action_chunk(loaded.preprocessor(dict(batch)))
            loaded.postprocessor(chunk)  # on the CPU at its end, so that the device has finished
            rates[n] = n / (time.perf_counter() - started)
    return rates


def _cameras(config: Any) -> dict[str, str]:
    """Return the field that each camera's images have in the checkpoint."""
    return dict(zip(CAMERA_KEYS, config.image_features, strict=True))


def _check_memory(limit: int, device: str) -> None:
    if device != "cpu" or not MEMINFO.is_file():
        return
    fields = dict(line.split(":", 1) for line in MEMINFO.read_text().splitlines())
    available = int(fields["MemAvailable"].split()[0]) * 1024
    if available < limit:
        raise CheckpointError(
            f"expected {_gb(limit)} of memory for this model, found {_gb(available)} available. Close other "
            "programs, or rehearse it on another machine."
        )


def reset_peak() -> None:
    """Let the peak of this process's memory begin from now, where the kernel can do that."""
    with contextlib.suppress(OSError):  # the peak is then that since the start: higher, never lower
        CLEAR_REFS.write_text("5")


def peak_rss_bytes() -> int:
    """Return the most memory that this process has had since `reset_peak`."""
    if STATUS.is_file():
        for line in STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _gb(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.{2 if n_bytes < 10e9 else 1}f} GB" if math.isfinite(n_bytes) else "—"
