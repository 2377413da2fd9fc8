"""Read a claim, of a run folder, a card, a published row or as a count; and how it was measured."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any  # fields of `EvalConfig`, as plain data

from vla_eval.config.files import to_data
from vla_eval.config.recorded_chunking import read_chunking
from vla_eval.errors import RecipeError, some_of, unknown_name
from vla_eval.results.claimed.acceptance import Claim
from vla_eval.results.exported.model_card import CARD, results_of_card
from vla_eval.results.grouping import POLICY_NAMES, RowEpisodes, RowKey, group_runs
from vla_eval.results.passport.settings import TASK_VERSIONS, task_version
from vla_eval.results.published.literature import PublishedResult, load_published
from vla_eval.storage.folders import RUN, kind_of
from vla_eval.storage.run_folder import StoredRun, read_run
from vla_eval.tasks.catalog import task_spec

COUNT = re.compile(r"(\d{1,6})/(\d{1,6})")
NOT_OF_THE_CLAIM = {
    *("tasks", "policies", "n_action_steps", "episodes", "seed_start", "runs"),
    *(POLICY_NAMES, TASK_VERSIONS),
}
"""Fields of a recorded configuration that are the plan's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Claimed:
    """A claim, what it is of, and how it was measured, as far as that is known."""

    claim: Claim
    of: str  # in words
    task: str
    n_action_steps: int | None = None
    # fields of `EvalConfig` that affect success: those of the claim's own run
    settings: Mapping[str, Any] = field(default_factory=dict)
    seeds: frozenset[int] = frozenset()  # of its episodes, where they are known
    notes: tuple[str, ...] = ()


def read_claim(
    text: str, *, task: str | None = None, n_action_steps: int | None = None, of: str | None = None
) -> Claimed:
    """Return the claim that a text names.

    Args:
        text: a run folder, a model card or the folder that it lies in, a published row (`BOARD/METHOD` or
            `METHOD`), or `K/N` successes.
        task: the task that the claim is of, where there are several.
        n_action_steps: likewise.
        of: the policy of a run folder that the claim is of, likewise.

    Raises:
        RecipeError: it is a claim of several things, or of nothing that can be measured again.
        RunFolderError, ReportError, UnknownNameError: there is no such folder, card or row.
    """
    if match := COUNT.fullmatch(text):
        if task is None:
            raise RecipeError(f"{text}: of which task? Name it with --task.")
        task_spec(task)  # whether there is one
        n_success, n_episodes = map(int, match.groups())
        claim = Claim(n_success=n_success, n_episodes=n_episodes)
        return Claimed(claim=claim, of="the claim", task=task, n_action_steps=n_action_steps)
    path = Path(text)
    if path.is_file() or (path.is_dir() and kind_of(path) != RUN and (path / CARD).is_file()):
        return _of_card(path, task=task, n_action_steps=n_action_steps)
    if path.exists():
        return _of_run(read_run(path), task=task, n_action_steps=n_action_steps, of=of)
    return _of_row(text, task=task, n_action_steps=n_action_steps)


def _of_run(run: StoredRun, *, task: str | None, n_action_steps: int | None, of: str | None) -> Claimed:
    groups = group_runs([run]).groups
    _check_of(of, sorted({key.policy for key in groups}), where=str(run.path))
    wanted: Mapping[str, object] = {"task": task, "n_action_steps": n_action_steps, "policy": of}
    rows = [row for key, row in groups.items() if _fits(key, wanted)]
    if not rows:
        raise RecipeError(
            f"{run.path}: expected a row with {_asked(wanted)}, found {some_of(groups) or 'no episode'}."
        )
    _check_one(str(run.path), [str(row.key) for row in rows], "--task, --n-action-steps or --of")
    return _claimed(run, rows[0])


def _claimed(run: StoredRun, row: RowEpisodes) -> Claimed:
    config, key = run.description.config, row.key
    results = row.results
    if not results or any(record.outcome == "finished" for record in results):
        raise RecipeError(
            f"{run.path}: {key}: expected episodes that succeed or fail, found "
            f"{'returns' if results else 'none with a result'}."
        )
    _check_version(run, key.task)
    settings: dict[str, Any] = {name: value for name, value in config.items() if name not in NOT_OF_THE_CLAIM}
    if isinstance(chunking := settings.get("chunking"), Mapping):
        settings["chunking"] = to_data(read_chunking(chunking, where=f"{run.path}: chunking"))
    notes = [f"{row.n_errors} episodes without a result are not part of the claim."] if row.n_errors else []
    return Claimed(
        claim=Claim(n_success=sum(one.outcome == "success" for one in results), n_episodes=len(results)),
        of=f"{key} in {run.path}",
        task=key.task,
        n_action_steps=key.n_action_steps,
        settings=settings,
        seeds=frozenset(record.seed for record in results),
        notes=tuple(notes),
    )


def _check_version(run: StoredRun, task: str) -> None:
    claimed = task_version(run, task)
    now = task_spec(task).version
    if claimed != now:
        raise RecipeError(
            f"{run.path}: {task}: the claim is of version {claimed} of the task, and this package has "
            f"version {now}: CHANGELOG.md says what differs. Measure the claim again."
        )


def _of_card(path: Path, *, task: str | None, n_action_steps: int | None) -> Claimed:
    wanted = {"task": task, "n_action_steps": n_action_steps}
    every = results_of_card(path)
    found = [
        one for one in every if task in (None, one.task) and n_action_steps in (None, one.n_action_steps)
    ]
    if not found:
        known = some_of(f"{one.task} K={one.n_action_steps}" for one in every)
        raise RecipeError(
            f"{path}: expected a result with {_asked(wanted) or 'a rate'}, found {known or 'none'}. "
            "`mikasa-vla report --card` writes results into a card."
        )
    _check_one(str(path), [f"{one.task} K={one.n_action_steps}" for one in found], "--task, --n-action-steps")
    (one,) = found
    task_spec(one.task)  # whether there is one
    return Claimed(
        claim=Claim(n_success=one.n_success, n_episodes=one.n_episodes),
        of=f"{one.task} in {path}",
        task=one.task,
        n_action_steps=one.n_action_steps or n_action_steps,
        notes=tuple(f"the card says: {name}: {text}." for name, text in one.settings.items()),
    )


def _of_row(text: str, *, task: str | None, n_action_steps: int | None) -> Claimed:
    published = load_published()
    names: dict[str, list[PublishedResult]] = {}
    for one in published.results:
        names.setdefault(f"{one.board}/{one.method}", []).append(one)
        names.setdefault(one.method, []).append(one)
    if text not in names:
        raise unknown_name("run folder or published row", text, names, where="CLAIM")
    cells = [
        (row, name)
        for row in names[text]
        for name in row.rates
        if task in (None, name) and n_action_steps in (None, row.n_action_steps)
    ]
    if not cells:
        wanted = {"task": task, "n_action_steps": n_action_steps}
        rates = ((row.n_action_steps, name) for row in names[text] for name in row.rates)
        known = some_of(f"{name} K={k or 'unknown'}" for k, name in rates)
        raise RecipeError(f"{text}: expected a rate with {_asked(wanted)}, found {known or 'a mean alone'}.")
    shown = [f"{row.board}/{row.method} on {name} K={row.n_action_steps}" for row, name in cells]
    _check_one(text, shown, "--task, --n-action-steps or BOARD/METHOD")
    (row, found), *_ = cells
    return _of_cell(row, found, n_action_steps)


def _of_cell(row: PublishedResult, task: str, n_action_steps: int | None) -> Claimed:
    if row.episodes is None:
        raise RecipeError(
            f"{row.method}: its source does not say of how many episodes the rate is, so that its "
            "uncertainty is not known. Give the claim as K/N."
        )
    rate = row.rates[task].rate
    stated = [*row.differs, *(f"perhaps {name}: {text}" for name, text in row.perhaps.items())]
    stated += [row.contested[task]] if task in row.contested else []
    notes = [f"{row.method}: {text}." for text in stated]
    if (row.runs or 1) > 1:
        notes.append(
            f"The rate is a mean of {row.runs} trainings, taken as one of {row.episodes} episodes: how far "
            "trainings differ is not part of the claim."
        )
    return Claimed(
        claim=Claim(n_success=round(rate * row.episodes), n_episodes=row.episodes),
        of=f"{row.label} on {task}, {load_published().sources[row.source].title}",
        task=task,
        n_action_steps=row.n_action_steps or n_action_steps,
        notes=tuple(notes),
    )


def _fits(key: RowKey, wanted: Mapping[str, object]) -> bool:
    return all(value is None or getattr(key, name) == value for name, value in wanted.items())


def _asked(wanted: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in wanted.items() if value is not None)


def _check_of(of: str | None, policies: Sequence[str], *, where: str) -> None:
    if of is not None and of not in policies:
        raise unknown_name("policy", of, policies, where=f"--of, {where}")


def _check_one(where: str, rows: Sequence[str], flags: str) -> None:
    if len(rows) > 1:
        raise RecipeError(f"{where}: expected one claim, found {some_of(rows)}. Choose one with {flags}.")
