"""Stored runs made of letters, for the tests of tables: `+` success, `-` failure, `e` error."""

from pathlib import Path
from types import SimpleNamespace

from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.results.report import Table
from vla_eval.storage.run_folder import RunDescription, StoredRun

COLOR, INTERCEPT = "RememberColor3-v0", "InterceptMedium-v0"


def episodes(policy: str, outcomes: str, **changes: object) -> list[EpisodeRecord]:
    """One episode per letter, seeds from 1: `+` success, `-` failure, `e` error."""
    return [episode(policy, seed, letter, **changes) for seed, letter in enumerate(outcomes, start=1)]


def episode(policy: str, seed: int, letter: str, **changes: object) -> EpisodeRecord:
    values: dict[str, object] = {"task": COLOR, "policy": policy, "n_action_steps": 1, "run": 0, "seed": seed}
    values |= {key: value for key, value in changes.items() if key in values}
    if letter == "e":
        error = EpisodeError(kind="WorkerCrashed", stage="step", message="gone")
        return EpisodeRecord(**values, outcome="error", error=error)  # type: ignore[arg-type]
    won = letter == "+"
    digest = "/".join(str(value) for value in (*values.values(), letter))
    values |= {"n_candidates": 3, "trajectory_sha256": digest, "n_inferences": 60, "success_at_end": won}
    values |= {"first_choice_success": won, "success_step": 30 if won else None, **changes}
    outcome = "success" if won else "failure"
    return EpisodeRecord(**values, outcome=outcome, success_once=won)  # type: ignore[arg-type]


def stored(*groups: list[EpisodeRecord], path: str = "runs/a", **config: object) -> StoredRun:
    description = RunDescription(
        name="demo",
        config=config,  # type: ignore[arg-type]
        recipes={},
        environment={},
        options={},
        command="",
    )
    return StoredRun(path=Path(path), description=description, records=tuple(r for g in groups for r in g))


def cells_of(table: Table) -> list[SimpleNamespace]:
    """The rows by the names of the columns of CSV and JSON."""
    return [SimpleNamespace(**row.to_dict()) for row in table.rows]


def only_row(table: Table, policy: str, **values: object) -> SimpleNamespace:
    (row,) = (
        row
        for row in cells_of(table)
        if row.policy == policy and all(getattr(row, name) == value for name, value in values.items())
    )
    return row


def has_note(table: Table, *parts: str) -> bool:
    return any(all(part in note for part in parts) for note in table.notes)
