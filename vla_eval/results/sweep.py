"""Compare results on the same episodes, by chunk length or policy; `docs/chunk_sizes.md` explains."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, get_args

import scipy

from vla_eval.chunking import ChunkingSettings
from vla_eval.config.recorded_chunking import read_chunking
from vla_eval.errors import ReportError, check_names, unknown_name
from vla_eval.results.comparison import Comparison, Evidence, compare, gather_evidence
from vla_eval.results.estimates import LEVEL
from vla_eval.results.formats import By
from vla_eval.results.grouping import RowEpisodes, RowKey, group_runs
from vla_eval.results.passport.settings import variant_labels
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import find_task
from vla_eval.tasks.spec import total_cue_steps

DEFAULT_DIFFERENCE = 0.1
POWER = 0.8
DEFAULT_CUE_STEPS = 5  # `cue_steps` of `MemoryTableEnv` and of the fake simulator; a test compares


class CueFrames(NamedTuple):
    """Frames of the cue that the policy got, minimum and maximum over the episodes."""

    fewest: int
    most: int

    def __str__(self) -> str:
        """Return `2`, or `2-3` if the cue's length is drawn per episode."""
        return str(self.most) if self.fewest == self.most else f"{self.fewest}-{self.most}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepRow:
    """One row, compared with its reference."""

    evidence: Evidence
    comparison: Comparison | None  # None for the reference itself; Holm's correction is over the table
    cue: CueFrames | None
    # episodes that would detect the given difference, at the level corrected for the number of comparisons
    # (Bonferroni, which Holm's method requires for its smallest p)
    n_to_settle: int | None

    @property
    def key(self) -> RowKey:
        """Task, policy, n_action_steps and variant."""
        return self.evidence.episodes.key


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Rows, grouped so that each reference stands with the rows that are compared with it."""

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
    """Compare rows that differ in one setting, `by`.

    `reference` is the value to compare with: a number of action steps, or a policy. By default the smallest
    number, or the first policy. The number of episodes is planned for `difference`, of success rates.

    Raises:
        ReportError: there are no episodes, nothing to compare, or an impossible difference.
        UnknownNameError: there is no such reference.
    """
    check_names("way to compare", [by], get_args(By), where="by")
    if not 0 < difference <= 1:
        raise ReportError(f"--difference is {difference}, expected a number above 0 and up to 1.")
    runs = list({run.path.resolve(): run for run in runs}.values())
    groups = group_runs(runs).groups
    if not any(group.results for group in groups.values()):
        raise ReportError(
            "There is no episode with a result yet. Start an evaluation with `mikasa-vla eval`."
        )
    references = _references(groups, by, reference)
    compared = compare(
        {key: (groups[key], groups[other]) for key, other in references.items() if other != key}
    )
    if not compared:
        raise ReportError(
            f"Nothing to compare: no two rows share episodes and differ in {by} alone. Evaluate several with "
            f"the same seeds, for example --n-action-steps 1 4 8, or name other runs."
        )
    evidence = gather_evidence(groups, {key: (compared.get(key),) for key in groups})
    arguments, chunkings = _env_arguments(runs), _chunkings(runs)
    level = LEVEL / len(compared)
    rows = [
        SweepRow(
            evidence=of,
            comparison=compared.get(key),
            cue=cue_frames(
                of.episodes,
                arguments.get((key.task, key.variant), {}),
                chunkings.get((key.task, key.variant), ChunkingSettings()),
            ),
            n_to_settle=_n_to_settle(of, evidence, difference, level),
        )
        for key, of in evidence.items()
    ]
    return Sweep(by=by, rows=tuple(rows), n_comparisons=len(compared), difference=difference, level=level)


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
    of: Evidence, evidence: Mapping[RowKey, Evidence], difference: float, level: float
) -> int | None:
    """Plan with the share of episodes that differed; if none did, with that of independent policies."""
    (compared,) = of.comparisons
    if compared is None:
        return None
    pairs = compared.pairs
    discordance = (pairs.only_first + pairs.only_second) / pairs.n_pairs
    if not discordance:
        first, second = of.success.success_once, evidence[compared.baseline].success.success_once
        assert first is not None and second is not None  # there is a pair
        discordance = discordance_of_independent(first, second)
    return episodes_to_settle(difference, discordance, level=level)


def _env_arguments(runs: Sequence[StoredRun]) -> dict[tuple[str, str | None], Mapping[str, Any]]:
    """Return (task, variant) -> the arguments of the task in those runs."""
    found: dict[tuple[str, str | None], Mapping[str, Any]] = {}
    for run, labels in zip(runs, variant_labels(runs), strict=True):
        env = run.description.config.get("env")
        for task, label in labels.items():
            found[task, label] = env if isinstance(env, Mapping) else {}
    return found


def _chunkings(runs: Sequence[StoredRun]) -> dict[tuple[str, str | None], ChunkingSettings]:
    """Return (task, variant) -> how chunks were executed in those runs."""
    found: dict[tuple[str, str | None], ChunkingSettings] = {}
    for run, labels in zip(runs, variant_labels(runs), strict=True):
        section = run.description.config.get("chunking")
        if isinstance(section, Mapping):
            chunking = read_chunking(section, where=str(run.path))
            found.update({(task, label): chunking for task, label in labels.items()})
    return found


def cue_frames(
    group: RowEpisodes,
    env: Mapping[str, Any],  # Any: the task's arguments
    chunking: ChunkingSettings = ChunkingSettings(),  # noqa: B008  # frozen
) -> CueFrames | None:
    """Return how many frames of the cue a row's policy got per episode, with these arguments of the task.

    The observation at step s shows the cue if s < cue_steps, counted from `cue_after_steps` on. A policy that
    reads the last frame gets those of its inferences, the first at step 0, that are among these; one that
    reads every frame gets all of them before it predicts. None for a task without a cue phase, if nothing was
    rendered, or if delays that vary move the inferences.
    """
    spec = find_task(group.key.task)
    if spec is None or spec.candidates is None or not group.results:
        return None
    arguments = {**spec.kwargs, **env}
    steps = arguments.get("cue_steps", DEFAULT_CUE_STEPS)
    n_in_turn = arguments.get("n_shown", 1) if spec.shows_one_by_one else 1
    gap_steps = arguments.get("gap_steps", 0)
    lengths = [steps] if isinstance(steps, int) else steps
    fewest, most = (total_cue_steps(f(lengths), n_in_turn, gap_steps) for f in (min, max))
    if any((r.n_frames or 0) > (r.n_inferences or 0) for r in group.results):  # it reads every frame
        return CueFrames(fewest, most)
    interval = chunking.at(group.key.n_action_steps).interval_steps
    if interval is None:
        return None
    after = arguments.get("cue_after_steps", 0)
    # Inferences before a step: rounded up, as there is one at step 0.
    earlier, by_fewest, by_most = (-(-step // interval) for step in (after, after + fewest, after + most))
    return CueFrames(by_fewest - earlier, by_most - earlier)


def episodes_to_settle(difference: float, discordance: float, *, level: float = LEVEL) -> int:
    """Return how many paired episodes a two-sided McNemar test needs to detect a difference with `POWER`.

    The difference of the rates is in (0, 1]; the discordance, the share of episodes in which the two differ,
    is raised to it if smaller. The level is that after any correction for several comparisons, in (0, 1).

    Source: Connor 1987, "Sample size for testing differences in proportions for the paired-sample
    design", Biometrics 43(1):207-211, equation 3: n = (z_{1-level/2} √ψ + z_{power} √(ψ - δ²))² / δ².
    It is for the asymptotic test; the exact one needs slightly more.
    """
    psi = max(discordance, difference)
    z_level = float(scipy.stats.norm.ppf(1 - level / 2))
    z_power = float(scipy.stats.norm.ppf(POWER))
    root = z_level * math.sqrt(psi) + z_power * math.sqrt(psi - difference**2)
    return math.ceil((root / difference) ** 2)


def discordance_of_independent(first: float, second: float) -> float:
    """Return how often two policies with these success rates differ if their outcomes are independent."""
    return first * (1 - second) + second * (1 - first)
