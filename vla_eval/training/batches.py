"""Which samples a training step gets: a function of run seed, step and process, wherever the training began.

The order is that of lerobot's `EpisodeAwareSampler` (a permutation for each epoch), shared among processes as
accelerate's `BatchSamplerShard` does. Neither can begin in the middle: accelerate sets the sampler's epoch
back to 0, and completes an epoch's last batches with samples from wherever the sampler began.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple  # Any: lerobot, accelerate and datasets are untyped

import numpy as np
import torch
from accelerate.data_loader import BatchSamplerShard
from accelerate.utils import send_to_device, set_seed
from lerobot.datasets import EpisodeAwareSampler, compute_sampler_state
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, Dataset, Sampler

from vla_eval.models.shared.earlier_frames import SEGMENT_PADDING_KEY

Batch = dict[str, Any]


class Position(NamedTuple):
    """Where a training continues: so many samples of an epoch have been taken, by all processes together."""

    epoch: int
    n_taken: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Sharing:
    """How an epoch is shared: in batches of `batch_size`, one after the other to each of the processes."""

    batch_size: int
    n_processes: int = 1
    process: int = 0

    def position(self, step: int, n_samples: int) -> Position:
        """Return where a training continues after so many steps, by as many processes."""
        state = compute_sampler_state(step, n_samples, self.batch_size, self.n_processes)
        return Position(epoch=state["epoch"], n_taken=state["start_index"])


class StepBatches(Sampler[list[Any]]):
    """Yields this process's indices for each step; if `numbered`, as `SeededSamples` takes them."""

    def __init__(
        self, sampler: EpisodeAwareSampler, start: Position, sharing: Sharing, *, numbered: bool = False
    ) -> None:
        self._sampler, self._start, self._sharing, self._numbered = sampler, start, sharing, numbered

    def __iter__(self) -> Iterator[list[Any]]:
        sharing = self._sharing
        skipped = self._start.n_taken // (sharing.batch_size * sharing.n_processes)
        for epoch in itertools.count(self._start.epoch):
            yield from itertools.islice(self._epoch(epoch, sharing), skipped, None)
            skipped = 0

    def _epoch(self, epoch: int, sharing: Sharing) -> Iterator[list[Any]]:
        self._sampler.load_state_dict({"epoch": epoch, "start_index": 0})
        samples: Any = self._sampler
        if self._numbered:
            samples = [(index, epoch, number) for number, index in enumerate(self._sampler)]
        whole = BatchSampler(samples, sharing.batch_size, drop_last=False)
        if sharing.n_processes == 1:  # the last batch of an epoch stays as short as it is
            return iter(whole)
        return iter(BatchSamplerShard(whole, sharing.n_processes, sharing.process))


class SeededSamples(Dataset[Any]):
    """Seeds each sample's random augmentation by run seed, epoch and number, in any process."""

    def __init__(self, dataset: Any, run_seed: int) -> None:
        self._dataset, self._run_seed = dataset, run_seed

    def __getitem__(self, sample: tuple[int, int, int]) -> Any:
        index, *place = sample
        drawn = np.random.SeedSequence(self._run_seed, spawn_key=(AUGMENTATION, *place)).generate_state(1)
        set_seed(int(drawn[0]))
        return self._dataset[index]


AUGMENTATION = 0x61756720  # apart from the seeds of steps, which have two numbers


def on_device(loader: "DataLoader[Any]", device: torch.device) -> Iterator[Any]:
    """Yield the loader's batches, moved to a device."""
    for batch in loader:
        yield send_to_device(batch, device, non_blocking=loader.pin_memory)


def preprocessed(preprocess: Callable[[Batch], Batch], batch: Batch) -> Batch:
    """Return a batch as the policy reads it; each segment goes through the pipeline as its own sample."""
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
