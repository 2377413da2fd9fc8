"""The order of the episodes on a real arm: complete blocks, each in random order.

A block has one episode of each stage, colour and policy. So what changes slowly (light, wear, a tired
operator) meets all of them alike, and an evaluation that ends early is balanced up to its last block.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from vla_eval.seeding import Stream, generator
from vla_eval.tasks.real_stages import COLORS, Stage, Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedEpisode:
    """A trial, and the policy that moves the arm, which the operator is not told."""

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
        draws = generator(seed, Stream.REAL_PLAN, block)
        for index in draws.permutation(len(rows)):
            stage, color, policy = rows[index]
            places = tuple(int(place) for place in draws.permutation(len(COLORS)))
            trial = Trial(place=len(planned), stage=stage, color=color, places=places)
            planned.append(PlannedEpisode(trial=trial, policy=policy))
    return tuple(planned)
