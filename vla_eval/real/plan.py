"""The order of the episodes on a real arm: complete blocks, each in random order.

A block has one episode of each stage, colour and policy. So what changes slowly (light, wear, a tired
operator) meets all of them alike, and an evaluation that ends early is balanced up to its last block. In a
block all policies meet the same places of the cubes, and have the same seed: they can be compared in pairs.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

from vla_eval.seeding import Stream, generator
from vla_eval.tasks.real_stages import COLORS, STAGES, Stage, Trial

FIRST_DEMONSTRATION_BLOCK = 1000
"""Evaluations have the blocks before it: no demonstration is of a trial in which a policy is evaluated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedEpisode:
    """A trial, and the policy that moves the arm, which is hidden from the operator."""

    trial: Trial
    policy: str


def make_plan(
    policies: Sequence[str], stages: Sequence[Stage], *, episodes: int, seed: int
) -> tuple[PlannedEpisode, ...]:
    """Return the episodes in their order; with more `episodes` per colour, it begins with the same ones.

    Args:
        policies: names; a block has each of them with each stage and colour.
        stages: which stages.
        episodes: how many per stage, colour and policy: as many blocks.
        seed: of the order, and of the places of the cubes.
    """
    blocks = (_block(policies, stages, number=number, seed=seed) for number in range(episodes))
    return tuple(planned for block in blocks for planned in block)


def demonstration_trials(stages: Sequence[Stage], *, seed: int) -> Iterator[Trial]:
    """Yield the trials of a recording without end, block after block; arguments as `make_plan`."""
    for number in itertools.count():
        first = _block(("",), stages, number=number, seed=seed, first_block=FIRST_DEMONSTRATION_BLOCK)
        yield from (planned.trial for planned in first)


def _block(
    policies: Sequence[str], stages: Sequence[Stage], *, number: int, seed: int, first_block: int = 0
) -> tuple[PlannedEpisode, ...]:
    rows = list(product(stages, range(len(COLORS)), policies))
    block = first_block + number
    planned: list[PlannedEpisode] = []
    for index in generator(seed, Stream.REAL_PLAN, block).permutation(len(rows)):
        stage, color, policy = rows[index]
        draws = generator(seed, Stream.REAL_PLAN, block, 1 + STAGES.index(stage), color)
        trial = Trial(
            number=number * len(rows) + len(planned) + 1,
            seed=block * len(COLORS) + color,
            stage=stage,
            color=color,
            places=tuple(int(place) for place in draws.permutation(len(COLORS))),
        )
        planned.append(PlannedEpisode(trial=trial, policy=policy))
    return tuple(planned)
