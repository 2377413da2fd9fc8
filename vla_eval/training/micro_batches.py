"""The gradient of one step, whose samples may go through the network in parts (gradient accumulation)."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple  # lerobot and accelerate are untyped

import torch
from torch import Tensor

from vla_eval.errors import TrainingError


class Loss(NamedTuple):
    """The loss of a whole batch, and what the policy reports with it, numbers averaged over samples."""

    value: Tensor
    parts: dict[str, Any]


def add_gradient(
    policy: Any,
    batch: Mapping[str, Any],
    accelerator: Any,
    *,
    size: int | None = None,
    autocast: torch.dtype | None = None,
    scale: Callable[[Tensor], Tensor] = lambda loss: loss,
) -> Loss:
    """Add the gradient of a batch's loss to the parameters'; `autocast`: the precision of the forward pass.

    In parts of `size` samples, it is that of the whole batch wherever the loss is a mean over samples that
    count alike (ACT's is not quite), except for noise, which the policy draws part by part.
    """
    whole, reported = torch.zeros(()), dict[str, Any]()
    parts = [(1.0, batch)] if size is None else list(_parts(batch, size))
    for index, (share, part) in enumerate(parts, start=1):
        # Processes exchange gradients once, with the last part.
        waits = accelerator.no_sync(policy) if index < len(parts) else contextlib.nullcontext()
        with waits:
            with torch.autocast(accelerator.device.type, autocast, enabled=autocast is not None):
                loss, output = policy.forward(part)
            loss = share * loss.to(torch.promote_types(loss.dtype, torch.float32))
            accelerator.backward(scale(loss))
        whole = whole.to(loss) + loss.detach()
        _add(reported, output, share)
    return Loss(whole, reported)


def _add(values: dict[str, Any], output: Mapping[str, Any] | None, share: float) -> None:
    """Add a part with this share of the samples; what is not a number is the last one's."""
    for name, value in (output or {}).items():
        if isinstance(value, float | int) and not isinstance(value, bool):
            value = values.get(name, 0.0) + share * value
        values[name] = value


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
