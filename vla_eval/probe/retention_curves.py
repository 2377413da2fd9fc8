"""The retention curves of a policy: following the cue, and following it in both worlds, by the delay."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from vla_eval.probe.quantities import follows, pair_up
from vla_eval.probe.retention import HalfLife, half_life
from vla_eval.probe.world_records import Worlds, chance_of, compared_with, results_of
from vla_eval.probe.worlds import AS_DRAWN, delay_of
from vla_eval.results.estimates import Share

RetentionOf = Literal["follows", "warranted_choice"]
LEAST_POINTS = 2


class RetentionPoint(NamedTuple):
    """A share after one delay, and what it is without memory; None where that is not known."""

    delay_steps: int
    share: Share
    chance: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Retention:
    """How the delay affects one policy on one task."""

    task: str
    policy: str
    n_action_steps: int
    # of the episodes, those that follow the cue; or of the pairs, those that follow it in both worlds
    of: RetentionOf
    points: tuple[RetentionPoint, ...]  # by growing delay, of all episodes or pairs with a result
    # of the episodes or pairs that have a result at each delay; None where it is undefined
    half_life: HalfLife | None


class _Level(NamedTuple):
    """What happened after one delay: (run, seed) -> whether the cue was followed."""

    outcomes: Mapping[tuple[int, int], bool]
    chance: float | None


def retention_curves(worlds: Worlds, policy: str, n_action_steps: int) -> list[Retention]:
    """Return the curves of one policy on one task; none if the delay was not changed."""
    key = (policy, n_action_steps)
    curves: list[tuple[RetentionOf, dict[int, _Level]]] = [
        ("follows", _followed(worlds, key)),
        ("warranted_choice", _warranted(worlds, key)),
    ]
    return [
        _curve(worlds[0][0].task, key, of, levels) for of, levels in curves if len(levels) >= LEAST_POINTS
    ]


def _followed(worlds: Worlds, key: tuple[str, int]) -> dict[int, _Level]:
    levels = {}
    for world, found in worlds:
        delay = delay_of(world.config)
        results = results_of(found.get(key, ()))
        if world.intervention in (AS_DRAWN, "delay") and delay is not None and results:
            outcomes = {(r.run, r.seed): follows(r) for r in results}
            levels[delay] = _Level(outcomes, chance_of(results, found, key[1]))
    return levels


def _warranted(worlds: Worlds, key: tuple[str, int]) -> dict[int, _Level]:
    """Return the pairs after each delay whose cue was swapped, too."""
    levels = {}
    swapped = [(world, found) for world, found in worlds if world.intervention == "delay_swap"]
    # The usual delay is that of the plain swap, of the same other cue.
    swaps = {world.config.env.get("swap_cue") for world, _ in swapped}
    swapped += [(one, found) for one, found in worlds if one.intervention == "swap" and one.level in swaps]
    for world, other in swapped:
        delay, drawn = delay_of(world.config), compared_with(world, worlds)
        pairs = pair_up(drawn.get(key, ()), other.get(key, ()))
        if delay is None or not pairs:
            continue
        chance = chance_of([pair.drawn for pair in pairs], drawn, key[1])
        outcomes = {
            (pair.drawn.run, pair.drawn.seed): follows(pair.drawn) and follows(pair.other) for pair in pairs
        }
        # What choices that do not depend on each other reach without the cue; a constant choice reaches 0.
        levels[delay] = _Level(outcomes, None if chance is None else chance**2)
    return levels


def _curve(task: str, key: tuple[str, int], of: RetentionOf, levels: Mapping[int, _Level]) -> Retention:
    delays = sorted(levels)
    shared = sorted(set.intersection(*(set(levels[delay].outcomes) for delay in delays)))
    chance = levels[delays[0]].chance
    held = {delay: np.array([levels[delay].outcomes[one] for one in shared], dtype=bool) for delay in delays}
    return Retention(
        task=task,
        policy=key[0],
        n_action_steps=key[1],
        of=of,
        points=tuple(
            RetentionPoint(delay, Share(sum(one.outcomes.values()), len(one.outcomes)), one.chance)
            for delay, one in sorted(levels.items(), key=lambda item: item[0])
        ),
        half_life=None if chance is None else half_life(held, chance),
    )
