"""Tables of learned policies: what is missing of one, and fine-tuning all that is. Knows no command line."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vla_eval.config.files import find_recipe
from vla_eval.config.shipped import search_folders
from vla_eval.errors import FolderInUseError, RecipeError
from vla_eval.evaluation.model_table import (
    Finetuning,
    ModelTable,
    describe_effort,
    finetunings,
    load_model_table,
    narrow,
)
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL
from vla_eval.workers.needed_files import Needed, shared_folder

RUNS_FOLDER = Path("runs")
Say = Callable[[str], None]
"""Takes a line for a person."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """The rows and tasks of a table that were asked for, and its folder."""

    table: ModelTable
    out: Path
    adapters: dict[str, str]  # of a table of tiny random models: row -> adapter of its own; else empty
    command: str  # what the user typed, for the record

    @property
    def is_tiny(self) -> bool:
        """Whether the models are tiny and random."""
        return bool(self.adapters)


def open_study(
    name: str, *, tasks: Sequence[str], rows: Sequence[str], out: Path | None, is_tiny: bool, command: str
) -> Study:
    """Read a table by its file, or its name in `configs/`; of some tasks and rows, or all if none is named.

    `out` is by default a folder in `runs/`; `is_tiny` puts tiny random models in place of the rows'. A
    `VlaEvalError` if there is no such table, row or task.
    """
    table = narrow(load_model_table(name), tasks=tasks, rows=rows)
    folder = out or RUNS_FOLDER / (table.name + ("_tiny" if is_tiny else ""))
    adapters: dict[str, str] = {}
    if is_tiny:
        from vla_eval.testing.tiny_table import tiny_table

        table, adapters = tiny_table(table, folder)
    return Study(table=table, out=folder, adapters=adapters, command=command)


def needed_files(study: Study) -> tuple[Needed, ...]:
    """Return the folders that workers write into and read from, and the user's recipes that they read."""
    from vla_eval.checkpoints.files import file_sha256

    found = dict.fromkeys(find_recipe("policies", row.policy) for row in study.table.rows)
    own = [path for path in found if path.parent != search_folders("policies")[-1]]
    recipes = [Needed(path=str(path), sha256=file_sha256(path), digest=file_sha256) for path in own]
    return (shared_folder(study.out), shared_folder(Path(study.table.datasets)), *recipes)


def finetune_study(
    study: Study,
    backend: Backend,
    *,
    device: str,
    allow_unreplayed: bool = False,
    say: Say,
    is_stopping: Callable[[], bool],
) -> bool:
    """Run all fine-tunings that are not finished and not begun elsewhere; False if asked to stop."""
    everything = finetunings(study.table, study.out)
    missing = unfinished(study)
    say(describe_effort(study.table, n_finished=len(everything) - len(missing)))
    _check(study.table, missing)
    todo = [one._replace(config=replace(one.config, device=device)) for one in missing]
    if allow_unreplayed:
        todo = [one._replace(config=replace(one.config, allow_unreplayed=True)) for one in todo]
    if backend is LOCAL:
        return _finetune_here(study, todo, say=say, is_stopping=is_stopping)
    from vla_eval.studies.table_on_cluster import finetune_on

    return finetune_on(
        backend,
        todo,
        logs=study.out / "logs",
        is_tiny=study.is_tiny,
        command=study.command,
        say=say,
        is_stopping=is_stopping,
    )


def _finetune_here(
    study: Study, todo: Sequence[Finetuning], *, say: Say, is_stopping: Callable[[], bool]
) -> bool:
    """Run one fine-tuning after the other in this process: each takes all GPUs of this machine."""
    from vla_eval.training.finetune import finetune

    with tiny_models(study):
        for index, one in enumerate(todo):
            if is_finished(one):
                continue
            name = f"[{index + 1}/{len(todo)}] {one.name}"
            say(name)
            try:
                done = finetune(one.config, command=study.command, say=say, is_stopping=is_stopping)
            except FolderInUseError:
                say("  another process is training it")
            else:
                if not done.is_finished:
                    say(f"{name}: stopped at step {done.step}. To resume: {study.command}")
                    return False
            _free_memory()
    return True


def _check(table: ModelTable, ahead: Sequence[Finetuning]) -> None:
    """Find missing datasets and bases now, which would otherwise stop the work after days."""
    from vla_eval.checkpoints.files import find_checkpoint
    from vla_eval.training.request import load_finetune_recipe

    missing = [one.config.dataset for one in ahead if not Path(one.config.dataset).is_dir()]
    if missing:
        raise RecipeError(
            f"{table.name}: {', '.join(dict.fromkeys(missing))}: expected a dataset, found no folder. Record "
            f"them: mikasa-vla record --task {' '.join(table.tasks)} --out {table.datasets}"
        )
    for config in {one.row.name: one.config for one in ahead}.values():
        base = load_finetune_recipe(config).value.base_checkpoint
        if base is not None:
            find_checkpoint(Path(base))


def unfinished(study: Study) -> list[Finetuning]:
    """Return the fine-tunings that have not come to their last step."""
    return [one for one in finetunings(study.table, study.out) if not is_finished(one)]


def is_finished(one: Finetuning) -> bool:
    """Whether a fine-tuning has a checkpoint of its last step."""
    from vla_eval.training.request import load_finetune_recipe
    from vla_eval.training.run_folder import whole_checkpoints

    whole = whole_checkpoints(Path(str(one.config.out)))
    return bool(whole) and int(whole[-1].name) >= load_finetune_recipe(one.config).value.steps


def record_tiny(study: Study, backend: Backend, *, allow_environment_change: bool) -> None:
    """Record the datasets of a table of tiny models."""
    from vla_eval.data.recording.record import record
    from vla_eval.testing.tiny_table import tiny_dataset

    record(
        tiny_dataset(study.table),
        out=Path(study.table.datasets),
        command=study.command,
        allow_environment_change=allow_environment_change,
        backend=backend,
    )


def tiny_models(study: Study) -> contextlib.AbstractContextManager[None]:
    """Build policies of lerobot's in their tiny form if the table is a tiny one."""
    if not study.is_tiny:
        return contextlib.nullcontext()
    from vla_eval.testing.tiny_models import tiny_forms

    return tiny_forms()


def _free_memory() -> None:
    import gc

    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
