"""Tables of learned policies: what is missing of one, and fine-tuning all that is. Knows no command line."""

import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vla_eval.config.evaluation import TimeoutConfig
from vla_eval.config.files import find_recipe, search_folders
from vla_eval.errors import FolderInUseError, RecipeError, TrainingError
from vla_eval.evaluation.model_table import (
    Finetuning,
    ModelTable,
    describe_effort,
    finetunings,
    load_model_table,
    narrow,
)
from vla_eval.storage.starting import RUNS_FOLDER
from vla_eval.strict.bounds import MAX_SECONDS
from vla_eval.training.finetune_jobs import RUNNER, Finetuned, FinetuneJob
from vla_eval.workers.backend import Backend, Pool
from vla_eval.workers.inside import RunnerClass
from vla_eval.workers.jobs import Answered, JobList
from vla_eval.workers.local import LOCAL
from vla_eval.workers.messages import Failed
from vla_eval.workers.needed_files import Needed, shared_folder
from vla_eval.workers.process import WorkerSpec

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
    """Read a table by its file, or its name in `configs/`; `is_tiny` replaces the rows' models."""
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
    return _finetune_on(study, backend, todo, say=say, is_stopping=is_stopping)


def _finetune_here(
    study: Study, todo: Sequence[Finetuning], *, say: Say, is_stopping: Callable[[], bool]
) -> bool:
    """Run one fine-tuning after the other in this process: each takes all GPUs of this machine."""
    from vla_eval.testing.process_memory import free_unused
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
            free_unused()
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


TINY_RUNNER = "vla_eval.testing.tiny_models:tiny_finetune_runner"
MAX_TRIES = 2  # of one fine-tuning, since a machine may hiccup; each resumes from its last checkpoint


def _finetune_on(
    study: Study, backend: Backend, todo: Sequence[Finetuning], *, say: Say, is_stopping: Callable[[], bool]
) -> bool:
    """Run the fine-tunings, a GPU each; return False if asked to stop. All machines share the logs."""
    logs = study.out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    jobs = [FinetuneJob(config=one.config, command=study.command, name=one.name) for one in todo]
    timeouts = TimeoutConfig(setup_seconds=MAX_SECONDS)
    runner = RunnerClass(target=TINY_RUNNER if study.is_tiny else RUNNER)
    spec = WorkerSpec(runner=runner, answers=(Finetuned,), timeouts=timeouts, logs=logs)
    size = max(1, min(len(jobs), backend.n_gpus or backend.n_cores))
    pool: Pool[FinetuneJob, Finetuned] = backend.pool(spec, size=size, takes_gpu=True)
    failed = _run(pool, jobs, say=say, is_stopping=is_stopping)
    if failed is None:
        return False
    if failed:
        raise TrainingError(
            f"{len(failed)} of {len(jobs)} fine-tunings failed; the others are finished. The same command "
            f"resumes these. Their output is in {logs}.\n" + "\n".join(failed)
        )
    return True


def _run(
    pool: Pool[FinetuneJob, Finetuned],
    jobs: Sequence[FinetuneJob],
    *,
    say: Say,
    is_stopping: Callable[[], bool],
) -> list[str] | None:
    """Run the jobs; return a sentence about each that failed, or None if it was asked to stop."""
    queue = JobList(jobs)
    n_tries: Counter[str] = Counter()
    failed: list[str] = []
    n_done = 0
    with pool as running:
        for event in running.run(queue):
            if event is None and is_stopping():
                return None
            if not isinstance(event, Answered):
                continue
            job, answer = event.job, event.answer
            if isinstance(answer, Failed) and answer.error.kind != FolderInUseError.__name__:
                n_tries[job.name] += 1
                if n_tries[job.name] < MAX_TRIES and not answer.refused:
                    queue.give_back(job)
                    continue
                failed.append(f"{job.name}: {answer.error.kind}: {answer.error.message}")
            n_done += 1
            say(f"[{n_done}/{len(jobs)}] {job.name}: {_outcome(answer)}")
    return failed


def _outcome(answer: Finetuned | Failed) -> str:
    if isinstance(answer, Finetuned):
        return "finished"
    if answer.error.kind == FolderInUseError.__name__:
        return "another process is training it"
    return f"{answer.error.kind}: {answer.error.message:.200}"
