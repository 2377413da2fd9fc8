"""Compare results on the same episodes: chunk lengths of a policy, or policies at one chunk length.

Reads and returns; changes nothing. `docs/chunk_sizes.md` explains each column.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vla_eval.errors import ReportError, unknown_name
from vla_eval.results.comparison import Chance, Success, ceiling_of, chance_of, count_pairs, success_of
from vla_eval.results.cue import CueFrames, cue_frames
from vla_eval.results.estimates import PairCounts, PairedTest, holm, mcnemar_exact
from vla_eval.results.formats import By
from vla_eval.results.grouping import RowEpisodes, RowKey, group_runs, variant_labels
from vla_eval.results.power import LEVEL, discordance_of_independent, episodes_to_settle
from vla_eval.storage.run_folder import StoredRun

DEFAULT_DIFFERENCE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepRow:
    """One row.

    Attributes:
        key: task, policy, n_action_steps, variant.
        n_episodes: with a result.
        success: its rate and interval.
        chance, ceiling: without memory, and with the answer, at the same n_action_steps.
        cue: frames of the cue that the policy got.
        reference: the row with which it is compared; None for the reference itself.
        test: paired exact McNemar, this row minus the reference.
        corrected_p: Holm over all comparisons of the table.
        n_to_settle: episodes that would detect the given difference, at the level corrected for the number
            of comparisons (Bonferroni, which Holm's method requires for its smallest p).
    """

    key: RowKey
    n_episodes: int
    success: Success
    chance: Chance | None
    ceiling: float | None
    cue: CueFrames | None
    reference: RowKey | None
    test: PairedTest | None
    corrected_p: float | None
    n_to_settle: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Rows, grouped so that each reference is beside the rows that are compared with it."""

    by: By
    rows: tuple[SweepRow, ...]
    n_comparisons: int
    difference: float
    level: float


def compare_runs(
    runs: Sequence[StoredRun],
    *,
    by: By = "n_action_steps",
    reference: str | None = None,
    difference: float = DEFAULT_DIFFERENCE,
) -> Sweep:
    """Compare rows that differ in one thing.

    Args:
        runs: what the run folders hold.
        by: the one setting in which the compared rows differ.
        reference: the value to compare with: a number of action steps, or a policy. By default the
            smallest number, or the first policy.
        difference: the difference of success rates for which the number of episodes is planned.

    Raises:
        ReportError: there are no episodes, nothing to compare, or an impossible difference.
        UnknownNameError: there is no such reference.
    """
    if not 0 < difference <= 1:
        raise ReportError(f"--difference is {difference}, expected a number above 0 and up to 1.")
    runs = list({run.path.resolve(): run for run in runs}.values())
    groups = group_runs(runs).groups
    if not any(group.results for group in groups.values()):
        raise ReportError(
            "There is no episode with a result yet. Start an evaluation with `mikasa-vla eval`."
        )
    references = _references(groups, by, reference)
    pairs = {
        key: count_pairs(groups[key], groups[other]) for key, other in references.items() if other != key
    }
    tests = {key: test for key, counts in pairs.items() if (test := mcnemar_exact(counts)) is not None}
    if not tests:
        raise ReportError(
            f"Nothing to compare: no two rows share episodes and differ in {by} alone. Evaluate several with "
            f"the same seeds, for example --n-action-steps 1 4 8, or name other runs."
        )
    corrected = dict(zip(tests, holm([test.p_value for test in tests.values()]), strict=True))
    successes = {key: success_of(group) for key, group in groups.items()}
    arguments = _env_arguments(runs)
    level = LEVEL / len(tests)
    rows = [
        SweepRow(
            key=key,
            n_episodes=len(group.results),
            success=successes[key],
            chance=chance_of(key, groups, successes),
            ceiling=ceiling_of(key, successes),
            cue=cue_frames(group, arguments.get((key.task, key.variant), {})),
            reference=references[key] if key in tests else None,
            test=tests.get(key),
            corrected_p=corrected.get(key),
            n_to_settle=_n_to_settle(key, references[key], pairs.get(key), successes, difference, level)
            if key in tests
            else None,
        )
        for key, group in groups.items()
    ]
    return Sweep(by=by, rows=tuple(rows), n_comparisons=len(tests), difference=difference, level=level)


def _references(groups: Mapping[RowKey, RowEpisodes], by: By, wanted: str | None) -> dict[RowKey, RowKey]:
    """Return row -> the row with which it is compared: equal in all settings but one."""
    values = list(dict.fromkeys(str(getattr(key, by)) for key in groups))
    if wanted is not None and wanted not in values:
        raise unknown_name(by, wanted, values, where="--reference")
    families: dict[tuple[object, ...], list[RowKey]] = {}
    for key in groups:
        rest = tuple(value for name, value in key._asdict().items() if name != by)
        families.setdefault(rest, []).append(key)
    found: dict[RowKey, RowKey] = {}
    for family in families.values():
        fitting = [key for key in family if str(getattr(key, by)) == wanted]
        # By default the shortest chunk, or the policy that was named first.
        first = min(family, key=lambda key: key.n_action_steps if by == "n_action_steps" else 0)
        chosen = fitting[0] if fitting else first if wanted is None else None
        found.update({key: chosen if chosen is not None else key for key in family})
    return found


def _n_to_settle(
    key: RowKey,
    other: RowKey,
    counts: PairCounts | None,
    successes: Mapping[RowKey, Success],
    difference: float,
    level: float,
) -> int | None:
    """Plan with the share of episodes that differed; if none did, with that of independent policies."""
    if counts is None:
        return None
    n_different = counts.only_first + counts.only_second
    if n_different:
        return episodes_to_settle(difference, n_different / counts.n_pairs, level=level)
    first, second = successes[key].success_once, successes[other].success_once
    if first is None or second is None:
        return None
    return episodes_to_settle(difference, discordance_of_independent(first, second), level=level)


def _env_arguments(runs: Sequence[StoredRun]) -> dict[tuple[str, str | None], Mapping[str, Any]]:
    """Return (task, variant) -> the arguments of the task in those runs."""
    found: dict[tuple[str, str | None], Mapping[str, Any]] = {}
    for run, labels in zip(runs, variant_labels(runs), strict=True):
        env = run.description.config.get("env")
        for task, label in labels.items():
            found[task, label] = env if isinstance(env, Mapping) else {}
    return found
