"""Gradient accumulation: one gradient step's samples go through the network in parts.

lerobot's step of training calls the policy's `forward` once and goes backwards from what it returns. So the
policy that it is given here does the same for all parts but the last, and returns the last one's loss.
"""

from collections.abc import Iterator, Mapping
from typing import Any  # lerobot and accelerate are untyped

import torch
from torch import Tensor

from vla_eval.errors import TrainingError


class InMicroBatches:
    """A policy for one gradient step; everything but its `forward` is the policy's own.

    The gradient is that of the whole batch wherever the policy's loss is a mean over samples that count
    alike (ACT's is one over actions that are no padding, so not quite), but for noise that the policy
    draws: it is drawn part by part.

    Args:
        policy: as accelerate has prepared it.
        accelerator: accelerate's `Accelerator`.
        micro_batch_size: samples of a part; the last one has what is left.
    """

    def __init__(self, policy: Any, accelerator: Any, micro_batch_size: int) -> None:
        self._policy, self._accelerator, self._size = policy, accelerator, micro_batch_size

    def __getattr__(self, name: str) -> Any:
        return getattr(self._policy, name)

    def forward(self, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Any]]:
        """Go backwards through all parts but the last.

        Returns:
            the whole batch's loss, whose gradient is the last part's; and what the policy tells, numbers
            averaged over samples.
        """
        *parts, (last_share, last) = _parts(batch, self._size)
        whole, told = 0.0, _Told()
        for share, part in parts:
            with self._accelerator.no_sync(self._policy):
                loss, output = self._policy.forward(part)
                # The whole of lerobot's forward is under autocast; a backward need not be.
                with torch.autocast(self._accelerator.device.type, enabled=False):
                    self._accelerator.backward(share * loss)
            whole = whole + share * loss.detach()
            told.add(output, share)
        loss, output = self._policy.forward(last)
        told.add(output, last_share)
        return whole + last_share * loss, told.values


class _Told:
    """What a policy tells of its loss, averaged over parts."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}

    def add(self, output: Mapping[str, Any] | None, share: float) -> None:
        """Add what was told of a part with this share of the samples; what is no number is the last one's."""
        for name, value in (output or {}).items():
            if isinstance(value, float | int):
                value = self.values.get(name, 0.0) + share * value
            self.values[name] = value


def _parts(batch: Mapping[str, Any], size: int) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield (share of the samples, part); a batch's tensors and lists have one entry per sample."""
    n_samples = len(batch["action"])
    for first in range(0, n_samples, size):
        rows = (first, min(first + size, n_samples))
        part = {name: _rows(name, value, rows, n_samples) for name, value in batch.items()}
        yield (rows[1] - first) / n_samples, part


def _rows(name: str, value: Any, rows: tuple[int, int], n_samples: int) -> Any:
    if isinstance(value, Mapping):
        return {key: _rows(f"{name}.{key}", inner, rows, n_samples) for key, inner in value.items()}
    if not isinstance(value, Tensor | list | tuple):
        return value
    if isinstance(value, Tensor) and value.ndim == 0:
        return value
    if len(value) != n_samples:
        raise TrainingError(
            f"finetune.micro_batch_size: the batch's field '{name}' has {len(value)} entries, expected one "
            f"for each of {n_samples} samples; it cannot be divided. Leave micro_batch_size out."
        )
    return value[slice(*rows)]
