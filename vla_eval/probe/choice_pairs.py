"""Pairs of episodes by the first choice in each of two worlds. Pure functions of records."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import compress

from vla_eval.probe.quantities import Pair, follows, pair_up
from vla_eval.probe.world_records import Worlds, compared_with
from vla_eval.probe.worlds import SWAPS, World
from vla_eval.tasks.objects.item_names import item_names

NO_CHOICE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoicePairs:
    """The pairs of one policy in a world with another cue."""

    world: World
    policy: str
    n_action_steps: int
    names: tuple[str, ...]  # of the candidates, by index, and `NO_CHOICE` last
    # by the indices of the choices in `names`, in the world as drawn and in the other one: how many
    # pairs have these choices, and how many of them follow the cue in both worlds
    counts: Mapping[tuple[int, int], int]
    following: Mapping[tuple[int, int], int]
    pairs: tuple[Pair, ...]  # the pairs themselves, by run and seed


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
        # `NO_CHOICE` follows the candidates.
        drawn, other = (
            [n_candidates if one.first_choice is None else one.first_choice for one in own]
            for own in zip(*pairs, strict=True)
        )
        choices = list(zip(drawn, other, strict=True))
        followed = [follows(pair.drawn) and follows(pair.other) for pair in pairs]
        found.append(
            ChoicePairs(
                world=world,
                policy=policy,
                n_action_steps=n_action_steps,
                names=(
                    *item_names(world.task, n_candidates, given=pairs[0].drawn.candidate_names),
                    NO_CHOICE,
                ),
                counts=Counter(choices),
                following=Counter(compress(choices, followed)),
                pairs=tuple(pairs),
            )
        )
    return found
