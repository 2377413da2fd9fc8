"""The order of the episodes on a real arm: complete blocks, each in random order.

A block has one episode of each stage, colour and policy. So what changes slowly (light, wear, a tired
operator) meets all of them alike, and an evaluation that ends early is balanced up to its last block. In a
block all policies meet the same places of the cubes, and have the same seed: they can be compared in pairs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from vla_eval.seeding import Stream, generator
from vla_eval.tasks.real_stages import COLORS, STAGES, Stage, Trial


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
    rows = list(product(stages, range(len(COLORS)), policies))
    planned: list[PlannedEpisode] = []
    for block in range(episodes):
        for index in generator(seed, Stream.REAL_PLAN, block).permutation(len(rows)):
            stage, color, policy = rows[index]
            own = block * len(COLORS) + color
            draws = generator(seed, Stream.REAL_PLAN, block, 1 + STAGES.index(stage), color)
            places = tuple(int(place) for place in draws.permutation(len(COLORS)))
            trial = Trial(number=len(planned) + 1, seed=own, stage=stage, color=color, places=places)
            planned.append(PlannedEpisode(trial=trial, policy=policy))
    return tuple(planned)
