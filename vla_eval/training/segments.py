"""Batches in segments, (B, T, …), through processors that know only (B, …)."""

from collections.abc import Callable
from typing import Any  # lerobot is untyped

from torch import Tensor

from vla_eval.models.shared.earlier_frames import SEGMENT_PADDING_KEY

Batch = dict[str, Any]


def preprocessed(preprocess: Callable[[Batch], Batch], batch: Batch) -> Batch:
    """Return a batch as the policy reads it; each segment goes through the processor as a sample of its own.

    Args:
        preprocess: lerobot's pipeline.
        batch: of the loader; one without segments goes through as it is.
    """
    if SEGMENT_PADDING_KEY not in batch:
        return preprocess(batch)
    padding = batch[SEGMENT_PADDING_KEY]
    n_samples, n_segments = padding.shape
    flat: Batch = {}
    for key, value in batch.items():
        if isinstance(value, Tensor):
            flat[key] = value.flatten(0, 1)
        else:
            flat[key] = [entry for entry in value for _ in range(n_segments)]
    del flat[SEGMENT_PADDING_KEY]
    done: Batch = {}
    for key, value in preprocess(flat).items():
        if isinstance(value, Tensor) and value.ndim and len(value) == n_samples * n_segments:
            done[key] = value.reshape(n_samples, n_segments, *value.shape[1:])
        elif isinstance(value, list) and len(value) == n_samples * n_segments:
            done[key] = value[::n_segments]
        else:
            done[key] = value
    return {**done, SEGMENT_PADDING_KEY: padding.to(done["action"].device)}
