"""Which tasks can be won without remembering? Run controls on each task; their counts give a verdict.

There are two protocols: `paper`, the tasks with their defaults, and `strict`, in which the arm is held until
the choice and the first choice is final. No audit proves that a task needs memory. It finds shortcuts among
those that its controls try.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import RecipeError
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import p_above, p_more
from vla_eval.results.shipped_audit import PROTOCOLS, AuditProtocol, Counts, TaskAudit
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.spec import TaskSpec

Kind = Literal["choice", "several", "ball", "no_choice"]

CONTROLS: Mapping[Kind, tuple[str, ...]] = {
    "choice": ("random", "hold", "oracle", "cue_blind", "tour", "cue_touch", "body_memory"),
    # One width of the gripper encodes one candidate; no control encodes several.
    "several": ("random", "hold", "oracle", "cue_blind", "tour", "cue_touch"),
    "ball": ("random", "hold", "oracle", "cue_blind", "one_frame"),
    "no_choice": ("random", "hold", "oracle", "cue_blind"),
}
WITHOUT_PHASES: frozenset[Kind] = frozenset({"ball", "no_choice"})
ALPHA = 0.001
"""Level of each test. All tasks need about 200 tests: less than one false finding in five audits."""

NEEDS_MEMORY = "needs memory"
UNDECIDED = "not decided"
SHORTCUTS = {
    "random": "won by chance motions",
    "tour": "can be toured",
    "body_memory": "body can store the cue",
    "cue_touch": "won by staying at the cue",
    "cue_blind": "won without the cue",
    "one_frame": "won from single frames",
}
WITHOUT_ACTING = "won without acting"


def kind_of(task: TaskSpec) -> Kind:
    """Return whether the task has one right candidate, several, or none; if none, whether a ball rolls."""
    if task.candidates is None:
        return "ball" if "velocity_range_m_s" in task.kwargs else "no_choice"
    return "several" if "n_shown" in task.kwargs else "choice"


def audit_configs(
    tasks: Sequence[str],
    protocols: Sequence[AuditProtocol],
    *,
    episodes: int,
    workers: int | Literal["auto"],
    settings: Mapping[str, Any] | None = None,  # Any: other fields of `EvalConfig`
) -> tuple[EvalConfig, ...]:
    """Return the evaluations that an audit consists of: one per protocol and kind of task.

    Args:
        tasks: task ids.
        protocols: which to run. Tasks without a choice have no phases, so the strict rule equals the
            paper's for them: they are run under `paper` only.
        episodes: per task and control, on seeds 1, 2, ….
        workers: processes, or one per core.
        settings: for example `simulator`.

    Raises:
        UnknownNameError: a task that is not in the catalogue.
        RecipeError: no evaluation remains.
    """
    _refuse_own_fields(settings or {})
    configs = []
    for protocol in protocols:
        for kind, controls in CONTROLS.items():
            of_kind = tuple(task for task in tasks if kind_of(task_spec(task)) == kind)
            if not of_kind or (protocol == "strict" and kind in WITHOUT_PHASES):
                continue
            configs.append(
                EvalConfig(
                    name=f"audit_{protocol}_{kind}",
                    tasks=of_kind,
                    policies=controls,
                    episodes=episodes,
                    env=dict(PROTOCOLS[protocol]),
                    workers=workers,
                    **(settings or {}),
                )
            )
    if not configs:
        raise RecipeError(
            f"--protocol strict: {', '.join(tasks)} have nothing to choose and no phases, so there is no "
            "strict rule for them. Use --protocol paper."
        )
    return tuple(configs)


def _refuse_own_fields(settings: Mapping[str, object]) -> None:
    for name in ("name", "tasks", "policies", "episodes", "workers", "env"):
        if name in settings:
            raise RecipeError(
                f"--set {name}: an audit sets this field itself. `mikasa-vla eval` lets you set it."
            )


def read_audit(configs: Sequence[EvalConfig], out: Path) -> tuple[TaskAudit, ...]:
    """Return the audit of each task and protocol from the run folders, in the order of the configurations."""
    audits = []
    for config in configs:
        records = read_run(out / config.name).records
        protocol: AuditProtocol = "strict" if config.env else "paper"
        for task in config.tasks:
            audits.append(audit_task(task, protocol, [r for r in records if r.task == task_spec(task).id]))
    return tuple(audits)


def audit_task(task: str, protocol: AuditProtocol, records: Sequence[EpisodeRecord]) -> TaskAudit:
    """Count the successes of each control on a task, and derive the verdict."""
    by_policy: dict[str, list[EpisodeRecord]] = {}
    for record in records:
        if record.outcome != "error":
            by_policy.setdefault(record.policy, []).append(record)
    # In the order of the controls; the order of the records depends on when workers finished.
    counts = {
        policy: _count(by_policy[policy])
        for policy in CONTROLS[kind_of(task_spec(task))]
        if policy in by_policy
    }
    chance = next((c.chance for c in counts.values() if c.chance is not None), None)
    return TaskAudit(
        task=task,
        version=task_spec(task).version,
        protocol=protocol,
        chance=chance,
        counts=counts,
        verdict=verdict(counts, chance),
        n_errors=sum(record.outcome == "error" for record in records),
    )


def _count(records: Sequence[EpisodeRecord]) -> Counts:
    chances = [record.chance_success for record in records if record.chance_success is not None]
    chooses = any(record.n_candidates for record in records)
    return Counts(
        n_episodes=len(records),
        success_once=sum(bool(record.success_once) for record in records),
        success_at_end=sum(bool(record.success_at_end) for record in records),
        first_choice=sum(bool(record.first_choice_success) for record in records) if chooses else None,
        chance=sum(chances) / len(chances) if chances else None,
    )


def verdict(counts: Mapping[str, Counts], chance: float | None) -> tuple[str, ...]:
    """Return the verdict: the shortcuts found, or that the oracle's knowledge of the cue decides.

    A control has found a shortcut if it beats chance (one-sided exact binomial test at `ALPHA`) or, if
    chance has to be measured, the blind arm (one-sided Fisher test at `ALPHA`). Doing nothing is a shortcut
    if it ever succeeds. Without a shortcut, a task `needs memory` if the oracle beats the blind arm;
    otherwise there were too few episodes.

    Args:
        counts: control -> its counts.
        chance: success rate of a perfect arm that ignores the cue.
    """
    oracle, blind = counts.get("oracle"), counts.get("cue_blind")
    found = [WITHOUT_ACTING] if "hold" in counts and counts["hold"].success_once else []
    for control, words in SHORTCUTS.items():
        if control in counts and _beats_memoryless(counts[control], chance, blind):
            found.append(words)
    if found:
        return tuple(found)
    decided = oracle is not None and blind is not None and beats(oracle, blind)
    return (NEEDS_MEMORY if decided else UNDECIDED,)


def _beats_memoryless(counts: Counts, chance: float | None, blind: Counts | None) -> bool:
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
