"""Pairs of episodes by the first choice in each of two worlds. Pure functions of records."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from vla_eval.probe.quantities import Pair, follows, pair_up
from vla_eval.probe.world_records import Worlds, compared_with
from vla_eval.probe.worlds import SWAPS, World
from vla_eval.tasks.objects.item_names import item_names

NO_CHOICE = "none"


class ChoicePair(NamedTuple):
    """The first choices in the world as drawn and in the other one; None where nothing was touched."""

    drawn: int | None
    other: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoicePairs:
    """The pairs of one policy in a world with another cue.

    Attributes:
        world: the other world.
        policy, n_action_steps: whose pairs they are.
        names: of the candidates, by index, and `NO_CHOICE` last.
        counts: how many pairs have these choices; those without a pair are left out.
        following: choices of pairs that follow the cue in both worlds.
        pairs: the pairs themselves, by run and seed.
    """

    world: World
    policy: str
    n_action_steps: int
    names: tuple[str, ...]
    counts: Mapping[ChoicePair, int]
    following: frozenset[ChoicePair]
    pairs: tuple[Pair, ...]

    def count(self, row: int, column: int) -> int:
        """Return the number of pairs by the indices of `names`."""
        return self.counts.get(self._choices(row, column), 0)

    def is_right(self, row: int, column: int) -> bool:
        """Whether some pair with these choices follows the cue in both worlds."""
        return self._choices(row, column) in self.following

    def _choices(self, row: int, column: int) -> ChoicePair:
        last = len(self.names) - 1
        return ChoicePair(None if row == last else row, None if column == last else column)


def choice_pairs(worlds: Worlds, policy: str, n_action_steps: int) -> list[ChoicePairs]:
    """Return the pairs of one policy in each world with another cue; none for tasks without candidates."""
    found = []
    for world, records in worlds:
        if world.intervention not in SWAPS:
            continue
        key = (policy, n_action_steps)
        pairs = pair_up(compared_with(world, worlds).get(key, ()), records.get(key, ()))
        n_candidates = max((pair.drawn.n_candidates or 0 for pair in pairs), default=0)
        if not n_candidates:
            continue
        followed = [pair for pair in pairs if follows(pair.drawn) and follows(pair.other)]
        found.append(
            ChoicePairs(
                world=world,
                policy=policy,
                n_action_steps=n_action_steps,
                names=(*item_names(world.task, n_candidates), NO_CHOICE),
                counts=Counter(map(_choices, pairs)),
                following=frozenset(map(_choices, followed)),
                pairs=tuple(pairs),
            )
        )
    return found


def _choices(pair: Pair) -> ChoicePair:
    return ChoicePair(pair.drawn.first_choice, pair.other.first_choice)
