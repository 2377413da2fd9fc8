"""Put the parts of a recording together as the datasets that one recording would have made."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.data.facts import DatasetFacts
from vla_eval.data.recording.folder import (
    ATTEMPTS_FILE,
    STATE_FOLDER,
    read_attempts,
    remove_shards,
    shard_path,
)
from vla_eval.data.recording.jobs import TaskPlan, join_job, shard_jobs
from vla_eval.data.recording.plan import plan_recording
from vla_eval.data.recording.seed_queue import SeedQueue, Selection
from vla_eval.data.recording.worker import join_dataset
from vla_eval.errors import MergeError
from vla_eval.storage.drafts import link_tree, whole_folder
from vla_eval.storage.durable import replace_file
from vla_eval.storage.run_file import RunFile, find_changes, listed
from vla_eval.storage.shard_parts import ShardPart, as_part, merge_descriptions, missing_shards
from vla_eval.strict.decoding import decode

OF_THE_PLAN = ("task_versions", "source")
"""Fields of a recording's configuration that are none of its recipe."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedTask:
    """What the parts have of one task: selection, a file of attempts, shards by number; what is missing."""

    plan: TaskPlan
    selection: Selection
    attempts: Path
    shards: dict[int, Path]
    missing: tuple[str, ...]


class _Tried(NamedTuple):
    folder: Path
    selection: Selection


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedRecording:
    """The description and the sessions of all parts, what they have of each task, and what is missing."""

    run_file: RunFile
    tasks: tuple[MergedTask, ...]
    missing: tuple[str, ...]


def merge_recordings(folders: Sequence[Path], *, allow_environment_change: bool = False) -> MergedRecording:
    """Read the parts of a recording, made by `record --shard`, and compare them; nothing is written."""
    parts = [as_part(folder, RunFile.load(folder / STATE_FOLDER)) for folder in folders]
    run_file = merge_descriptions(parts, allow_environment_change=allow_environment_change)
    tasks = tuple(_merge_task(task, parts) for task in _plan(run_file, folders[0]))
    missing = (*missing_shards(parts), *(line for task in tasks for line in task.missing))
    return MergedRecording(run_file=run_file, tasks=tasks, missing=missing)


def write_recording(merged: MergedRecording, out: Path) -> tuple[DatasetFacts, ...]:
    """Write the recording, which `record` resumes if anything is missing; after an error nothing is left."""
    with whole_folder(out, error=MergeError) as draft:
        for task in merged.tasks:
            attempts = draft / STATE_FOLDER / task.plan.task / ATTEMPTS_FILE
            attempts.parent.mkdir(parents=True)
            if task.attempts.is_file():  # else the part had not begun with this task
                replace_file(attempts, task.attempts.read_text(encoding="utf-8"))
            for index, shard in task.shards.items():
                link_tree(shard, shard_path(draft, task.plan.task, index))
        merged.run_file.save(draft / STATE_FOLDER)
        whole = () if merged.missing else merged.tasks
        return tuple(_join(task, merged.run_file, draft) for task in whole)


def _plan(run_file: RunFile, where: Path) -> tuple[TaskPlan, ...]:
    """Return what was planned; planned again here, and compared."""
    description = run_file.description
    fields = {name: value for name, value in description.config.items() if name not in OF_THE_PLAN}
    recipe = decode(DatasetRecipe, {"name": description.name, **fields}, where=str(where / STATE_FOLDER))
    plan = plan_recording(recipe)
    versions = {one.task: one.task_version for one in plan.tasks}
    changes = (
        *find_changes(description.recipes, plan.recipe_files, prefix="recipes"),
        *find_changes(description.config, {**description.config, "task_versions": versions}, prefix="config"),
    )
    if changes:
        raise MergeError(
            f"{where}: expected the recipes that it was recorded with, found others:\n{listed(changes)}\n"
            f"Merge it with the version of mikasa-vla-eval and the recipes that recorded it."
        )
    return plan.tasks


def _merge_task(task: TaskPlan, parts: Sequence[ShardPart]) -> MergedTask:
    selections = {part.path: _selection(task, part) for part in parts}
    tried = [_Tried(path, selection) for path, selection in selections.items() if selection is not None]
    for other in tried[1:]:
        _refuse_other_attempts(task, tried[0], other)
    missing = [
        f"{_of_task(task, part)}: not all seeds are tried. To resume: {part.run_file.sessions[-1].command}"
        for part in parts
        if selections[part.path] is None
    ]
    first = tried[0] if tried else _Tried(parts[0].path, Selection(kept=(), failed=()))
    shards: dict[int, Path] = {}
    for index, n_before in enumerate(range(0, len(first.selection.kept), task.recipe.episodes_per_shard)):
        for part in parts:
            path = shard_path(part.path, task.task, index)
            if not part.shard.holds(n_before):
                continue
            if path.is_dir():
                shards[index] = path
            elif selections[part.path] is not None:
                command = part.run_file.sessions[-1].command
                missing.append(f"{_of_task(task, part)}: {path.name} is not rendered. To resume: {command}")
    return MergedTask(
        plan=task,
        selection=first.selection,
        attempts=first.folder / STATE_FOLDER / task.task / ATTEMPTS_FILE,
        shards=shards,
        missing=tuple(missing),
    )


def _of_task(task: TaskPlan, part: ShardPart) -> str:
    return f"{part.path} (shard {part.shard}): {task.task}"


def _selection(task: TaskPlan, part: ShardPart) -> Selection | None:
    queue = SeedQueue(task, read_attempts(part.path, task.task))
    return None if queue.has_next() else queue.selection()


def _refuse_other_attempts(task: TaskPlan, first: _Tried, other: _Tried) -> None:
    """Raise `MergeError` where the expert has acted differently: the machines do not compute the same."""
    pairs = zip(first.selection.attempts(), other.selection.attempts(), strict=False)
    differing = next((one.seed for one, two in pairs if one != two), None)
    if differing is not None:
        raise MergeError(
            f"{other.folder}: expected the expert to act on {task.task} as in {first.folder}, found that "
            f"seed {differing} differs. The machines do not compute the same: record all parts on machines "
            f"of one kind."
        )


def _join(task: MergedTask, run_file: RunFile, draft: Path) -> DatasetFacts:
    name = task.plan.task
    jobs = shard_jobs(task.plan, task.selection.kept, lambda index: shard_path(draft, name, index))
    job = join_job(task.plan, draft / name, shards=jobs, failed=task.selection.failed, run_file=run_file)
    facts = join_dataset(job)
    remove_shards(draft, name)
    return facts
