"""Which tasks can be won without remembering? Run controls on each task; their counts give a verdict."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from vla_eval.audit.verdicts import verdict
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import RecipeError, check_names, some_of
from vla_eval.records import EpisodeRecord
from vla_eval.results.shipped_audit import PROTOCOLS, AuditProtocol, Counts, TaskAudit
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import robot_task, task_spec
from vla_eval.tasks.spec import TaskSpec

Kind = Literal["choice", "search", "several", "ball", "cube", "no_choice", "unscripted"]

CONTROLS: Mapping[Kind, tuple[str, ...]] = {
    "choice": ("random", "hold", "oracle", "cue_blind", "tour", "cue_touch", "body_memory"),
    # The official wrapper stops the arm until the choice, or the right mug moves after it was shown.
    "search": ("random", "hold", "oracle", "tour"),
    # One width of the gripper encodes one candidate; no control encodes several.
    "several": ("random", "hold", "oracle", "cue_blind", "tour", "cue_touch"),
    "ball": ("random", "hold", "oracle", "cue_blind", "one_frame"),
    "cube": ("random", "hold", "oracle", "cue_blind", "one_frame"),
    "no_choice": ("random", "hold", "oracle", "cue_blind"),
    "unscripted": ("random", "hold"),
}
WITHOUT_PHASES: frozenset[Kind] = frozenset({"ball", "cube", "no_choice"})
OFFICIAL_FIELDS: Mapping[str, Any] = {"seed_start": 4242424242, "stop_at_success": True}
"""What differs in an evaluation of official tasks: the seeds of their runner (protocols/mikasa_vla_90.yaml).
Their metric is success at any step, so that an episode may end there."""


def kind_of(task: TaskSpec) -> Kind:
    """Return whether the task has one right candidate, several, or none; if none, what one frame shows."""
    if not task.oracle:
        return "unscripted"
    if task.is_official and task.has_candidates:
        return "search" if task.waits_for_choice or task.phase_source == "none" else "choice"
    if task.candidates is None:
        return task.seen_in_one_frame or "no_choice"
    return "several" if task.several_right else "choice"


def protocols_of(tasks: Sequence[str], wanted: Sequence[AuditProtocol]) -> tuple[AuditProtocol, ...]:
    """Return the protocols under which tasks are audited: those wanted, or the official tasks' only one."""
    official = {
        task: robot_task(task, does="an audit with an arm's controls is of").is_official for task in tasks
    }
    if not any(official.values()):
        return tuple(wanted)
    if not all(official.values()):
        own = ", ".join(task for task, is_official in official.items() if not is_official)
        raise RecipeError(
            f"{own}: audited under other protocols than the official package's tasks. Audit these apart."
        )
    return ("official",)


def audit_configs(
    tasks: Sequence[str],
    protocols: Sequence[AuditProtocol],
    *,
    episodes: int,
    workers: int | Literal["auto"],
    controls: Sequence[str] | None = None,
    settings: Mapping[str, Any] | None = None,  # Any: other fields of `EvalConfig`
) -> tuple[EvalConfig, ...]:
    """Return the evaluations that an audit consists of: one per protocol and kind of task.

    Tasks without a choice have no phases, so the strict rule equals the paper's for them: they are run under
    `paper` only. The episodes are per task and control, on seeds 1, 2, … or, of official tasks, on those of
    their runner. Only these controls, if given; `settings` are other fields, such as `simulator`.
    """
    known = list(dict.fromkeys(name for names in CONTROLS.values() for name in names))
    check_names("control", controls or (), known, where="--control")
    fields = dict(settings or {})
    # An official task's arguments change no rule: which mug, how many steps.
    refuse_own_fields(fields, own=() if tuple(protocols) == ("official",) else ("env",))
    given_env = fields.pop("env", {})
    configs = []
    for protocol in protocols:
        for kind, of_this_kind in CONTROLS.items():
            of_kind = tuple(task for task in tasks if kind_of(task_spec(task)) == kind)
            policies = tuple(name for name in of_this_kind if controls is None or name in controls)
            if not of_kind or not policies or (protocol == "strict" and kind in WITHOUT_PHASES):
                continue
            configs.append(
                EvalConfig(
                    name=f"audit_{protocol}_{kind}",
                    tasks=of_kind,
                    policies=policies,
                    episodes=episodes,
                    env={**PROTOCOLS[protocol].arguments, **given_env},
                    workers=workers,
                    **{**(OFFICIAL_FIELDS if protocol == "official" else {}), **fields},
                )
            )
    if not configs:
        raise RecipeError(_nothing_left(tasks, protocols, controls))
    return tuple(configs)


def _nothing_left(
    tasks: Sequence[str], protocols: Sequence[AuditProtocol], controls: Sequence[str] | None
) -> str:
    names = some_of(tasks)
    if controls is not None:
        return f"--control {' '.join(controls)}: none of these fits {names}. Leave --control out."
    return (
        f"--protocol {' '.join(protocols)}: {names} have nothing to choose and no phases, so there is no "
        "strict rule for them. Use --protocol paper."
    )


def refuse_own_fields(settings: Mapping[str, object], *, own: Sequence[str] = ()) -> None:
    """Refuse to set what every audit sets itself, and the fields that this one sets besides."""
    for name in ("name", "tasks", "policies", "episodes", "workers", *own):
        if name in settings:
            raise RecipeError(
                f"--set {name}: an audit sets this field itself. `mikasa-vla eval` lets you set it."
            )


def read_audit(configs: Sequence[EvalConfig], out: Path) -> tuple[TaskAudit, ...]:
    """Return the audit of each task and protocol from the run folders, in the order of the configurations."""
    audits = []
    for config in configs:
        records = read_run(out / config.name).records
        (protocol,) = (one for one in PROTOCOLS if config.name.startswith(f"audit_{one}_"))
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
    kind = kind_of(task_spec(task))
    counts = {policy: _count(by_policy[policy]) for policy in CONTROLS[kind] if policy in by_policy}
    chance = next((c.chance for c in counts.values() if c.chance is not None), None)
    return TaskAudit(
        task=task,
        version=task_spec(task).version,
        protocol=protocol,
        chance=chance,
        counts=counts,
        verdict=verdict(counts, chance, scripted=kind != "unscripted"),
        n_errors=sum(record.outcome == "error" for record in records),
    )


def _count(records: Sequence[EpisodeRecord]) -> Counts:
    chances = [record.chance_success for record in records if record.chance_success is not None]
    chooses = any(record.n_candidates for record in records)
    at_end = [record.success_at_end for record in records]
    return Counts(
        n_episodes=len(records),
        success_once=sum(bool(record.success_once) for record in records),
        success_at_end=None if None in at_end else sum(map(bool, at_end)),
        first_choice=sum(bool(record.first_choice_success) for record in records) if chooses else None,
        chance=sum(chances) / len(chances) if chances else None,
    )
