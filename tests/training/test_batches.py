"""A resumed training gets the samples of the uninterrupted one, in later epochs and in every process."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accelerate.data_loader import prepare_data_loader
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.datasets import EpisodeAwareSampler
from torch.utils.data import DataLoader

from tests.training.tiny_trainings import act, finetune_losses
from vla_eval.training.batches import Position, SeededSamples, Sharing, StepBatches


def sampler(lengths: list[int], seed: int = 3, drop: int = 0) -> EpisodeAwareSampler:
    ends = [sum(lengths[: i + 1]) for i in range(len(lengths))]
    begins = [end - length for end, length in zip(ends, lengths, strict=True)]
    return EpisodeAwareSampler(begins, ends, drop_n_last_frames=drop, shuffle=True, seed=seed)


def steps(lengths: list[int], sharing: Sharing, first: int, n: int) -> list[list[int]]:
    order = sampler(lengths)
    batches = iter(StepBatches(order, sharing.position(first, len(order)), sharing))
    return [next(batches) for _ in range(n)]


def uninterrupted(lengths: list[int], sharing: Sharing, n: int) -> list[list[int]]:
    """Return what accelerate hands out when nothing stops it: the order of all trainings so far."""
    data = list(range(sum(lengths)))
    plain = DataLoader(data, batch_size=sharing.batch_size, sampler=sampler(lengths))
    loader: Any = prepare_data_loader(
        plain, num_processes=sharing.n_processes, process_index=sharing.process, put_on_device=False
    )
    found: list[list[int]] = []
    while len(found) < n:
        found += [batch.tolist() for batch in loader]
    return found[:n]


CASES = st.tuples(
    st.lists(st.integers(1, 9), min_size=1, max_size=6),  # frames of the episodes
    st.integers(1, 11),  # batch_size
    st.integers(1, 3),  # processes
)


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(case=CASES, stopped=st.integers(0, 40))
def test_what_follows_a_stop_is_what_follows_without_one(
    case: tuple[list[int], int, int], stopped: int
) -> None:
    lengths, size, n_processes = case
    for process in range(n_processes):
        sharing = Sharing(batch_size=size, n_processes=n_processes, process=process)
        whole = steps(lengths, sharing, 0, stopped + 12)
        assert steps(lengths, sharing, stopped, 12) == whole[stopped:]


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(case=CASES)
def test_the_order_is_that_of_accelerate(case: tuple[list[int], int, int]) -> None:
    lengths, size, n_processes = case
    for process in range(n_processes):
        sharing = Sharing(batch_size=size, n_processes=n_processes, process=process)
        assert steps(lengths, sharing, 0, 25) == uninterrupted(lengths, sharing, 25)


def test_each_epoch_holds_each_frame_once() -> None:
    """46 frames in batches of 4 are 12 batches: the last has 2."""
    found = steps([20, 26], Sharing(batch_size=4), 0, 24)
    first, second = found[:12], found[12:]
    assert sorted(itertools.chain(*first)) == sorted(itertools.chain(*second)) == list(range(46))
    assert first != second and len(first[11]) == 2


def test_other_processes_go_on_where_the_first_ones_stopped() -> None:
    """After 3 steps of two processes with batches of 4, 24 frames are taken: one process is at its 7th."""
    before = Sharing(batch_size=4, n_processes=2)
    assert before.position(3, 46) == Position(epoch=0, n_taken=24)
    order = sampler([20, 26])
    alone = iter(StepBatches(order, before.position(3, len(order)), Sharing(batch_size=4)))
    assert next(alone) == steps([20, 26], Sharing(batch_size=4), 0, 7)[6]


class Noisy(torch.utils.data.Dataset[Any]):
    """Its samples are random, as augmented images are."""

    def __getitem__(self, index: int) -> Any:
        return torch.tensor([index, float(torch.rand(())), float(np.random.rand())])  # noqa: TID251  # the global one


@pytest.mark.parametrize("num_workers", [0, 2])
def test_augmentation_depends_on_the_sample_alone(num_workers: int) -> None:
    sharing = Sharing(batch_size=4)

    def drawn(first: int, n: int) -> list[Any]:
        order = sampler([20, 26])
        batches = StepBatches(order, sharing.position(first, len(order)), sharing, numbered=True)
        loader = DataLoader(SeededSamples(Noisy(), 3), batch_sampler=batches, num_workers=num_workers)
        found = iter(loader)
        return [next(found).tolist() for _ in range(n)]

    whole = drawn(0, 16)
    assert drawn(13, 3) == whole[13:]
    assert len({row[1] for batch in whole for row in batch}) == 12 * 4 - 2 + 16  # none twice


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("stopped", [7, *(pytest.param(step, marks=pytest.mark.slow) for step in (9, 15))])
def test_a_resumed_training_is_the_uninterrupted_one(
    recorded: Path, tmp_path: Path, killed_at: Any, small_act: None, num_workers: int, stopped: int
) -> None:
    """55 frames in batches of 8 are 7 steps an epoch: at its end, after it, and in the third."""
    changes = {
        "steps": 18,
        "batch_size": 8,
        "save_every_steps": stopped,
        "num_workers": num_workers,
        "image_transforms": {"max_num_transforms": 2},
    }
    whole = finetune_losses(act(recorded, tmp_path / "whole", **changes))
    resumed = act(recorded, tmp_path / "resumed", **changes)
    with killed_at(stopped):
        finetune_losses(resumed)
    assert finetune_losses(resumed) == whole
    assert len(whole) == 18
