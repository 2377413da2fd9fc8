"""The verdict on a task, from the counts of its controls. Knows nothing of runs.

No audit proves that a task needs memory. It finds shortcuts among those that its controls try.
"""

from collections.abc import Mapping

from vla_eval.results.estimates import p_above, p_more
from vla_eval.results.shipped_audit import NEEDS_MEMORY, NOT_AUDITED, SHORTCUTS, UNDECIDED, Counts

ALPHA = 0.001
"""Level of each test. All tasks need about 200 tests: less than one false finding in five audits."""


def verdict(counts: Mapping[str, Counts], chance: float | None, *, scripted: bool = True) -> tuple[str, ...]:
    """Return the verdict: the shortcuts found, or that the oracle's knowledge of the cue decides.

    Tests are exact binomial (against a known chance) or Fisher (against the blind arm), one-sided at `ALPHA`.
    Doing nothing is a shortcut if it ever succeeds. Without a shortcut, a task `needs memory` if the oracle
    beats every other control and, where that is known, chance; otherwise there were too few episodes.
    """
    blind = counts.get("cue_blind")
    found = [
        words
        for control, (words, _) in SHORTCUTS.items()
        if control in counts and _finds_shortcut(control, counts[control], chance, blind)
    ]
    if not scripted:
        found.append(NOT_AUDITED)
    if found:
        return tuple(found)
    return (NEEDS_MEMORY if _beats_all(counts, chance) else UNDECIDED,)


def _beats_all(counts: Mapping[str, Counts], chance: float | None) -> bool:
    """Whether the oracle beats every control that does not know the answer, and chance if that is known."""
    others = [one for control, one in counts.items() if control != "oracle"]
    oracle = counts.get("oracle")
    if oracle is None or not others:
        return False
    beats_luck = beats_chance(oracle, chance) if chance is not None else "cue_blind" in counts
    return beats_luck and all(beats(oracle, other) for other in others)


def _finds_shortcut(control: str, counts: Counts, chance: float | None, blind: Counts | None) -> bool:
    if control == "hold":
        return counts.success_once > 0
    if chance is not None:
        return beats_chance(counts, chance)
    return blind is not None and beats(counts, blind)


def beats_chance(counts: Counts, chance: float) -> bool:
    """Whether this number of successes is significantly above a success rate of `chance`."""
    return p_above(counts.success_once, counts.n_episodes, chance) < ALPHA


def beats(one: Counts, other: Counts) -> bool:
    """Whether the first succeeds significantly more often than the second."""
    first, second = ((c.success_once, c.n_episodes) for c in (one, other))
    return p_more(first, second) < ALPHA
