"""The success rate of a perfect arm that ignores the cue. Pure arithmetic."""

import math


def chance_of_several(n_items: int, n_shown: int, *, in_order: bool) -> float:
    """Return the probability that `n_shown` different items drawn uniformly are those that were shown.

    Args:
        n_items: how many items there are.
        n_shown: how many were shown; the arm knows that number.
        in_order: whether their order must also be the one shown.
    """
    return 1 / (math.perm(n_items, n_shown) if in_order else math.comb(n_items, n_shown))
