"""Record demonstrations: choose seeds without rendering, render and encode what is kept, put it together.

One LeRobotDataset per task, OUT/TASK. Stopped at any moment, the same call resumes; the result does not
depend on that, nor on the number of workers.
"""

import functools
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, Self

from vla_eval.config.dataset import OPTION_FIELDS, DatasetRecipe
from vla_eval.config.files import content_of, options_of
from vla_eval.data.facts import DatasetFacts, read_facts
from vla_eval.data.manifest import RECORDING_FILE, FailedSeed, read_failed, read_manifest
from vla_eval.data.recording.demonstrations import Attempt
from vla_eval.data.recording.folder import RecordingFolder, remove_shards
from vla_eval.data.recording.jobs import (
    JoinJob,
    RecordingAnswer,
    RecordingJob,
    ShardJob,
    TaskPlan,
    join_job,
    shard_jobs,
)
from vla_eval.data.recording.plan import plan_recording
from vla_eval.data.recording.seed_queue import SeedQueue, Selection
from vla_eval.envs.factory import slow_modules
from vla_eval.errors import RecordingError
from vla_eval.storage.provenance import collect_environment
from vla_eval.storage.run_file import RunDescription
from vla_eval.storage.shard import Shard
from vla_eval.strict.devices import refuse_missing_gpu
from vla_eval.workers.backend import Backend, Pool
from vla_eval.workers.inside import RunnerClass
from vla_eval.workers.jobs import Answered, JobList
from vla_eval.workers.local import LOCAL
from vla_eval.workers.messages import DeviceFound, Failed, as_exception
from vla_eval.workers.process import WorkerSpec

WORKER_MODULE = "vla_eval.data.recording.worker"
MAX_TRIES = 2  # of one job, since a machine may hiccup; what fails twice is not an accident

Phase = Literal["trying seeds", "converting", "rendering", "joining", "replaying"]
RecordingPool = Pool[RecordingJob, RecordingAnswer]


class RecordingObserver(Protocol):
    """Watches a recording or a replay: progress on a terminal, for example."""

    def on_phase(self, task: str, phase: Phase, *, n_done: int, n_total: int) -> None:
        """Called when a phase of a task begins, with how many episodes are done already."""

    def on_progress(self, *, n_done: int) -> None:
        """Called when more is done of the phase."""

    def on_mismatch(self, sentence: str) -> None:
        """Called for each mismatch that a replay finds."""

    def on_tick(self) -> bool:
        """Called several times a second; returns whether to stop now."""


class _Silence:
    def on_tick(self) -> bool:
        return False

    def _ignore(self, *_: object, **__: object) -> None:
        """Do nothing."""

    on_phase = on_progress = on_mismatch = _ignore


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedDataset:
    """One finished dataset."""

    path: Path
    facts: DatasetFacts
    failed: tuple[FailedSeed, ...]
    kept_failures: tuple[int, ...]  # seeds of the episodes without success
    seconds: float  # of this call

    @classmethod
    def read(cls, path: Path, *, seconds: float) -> Self:
        """Read the dataset in a folder."""
        return cls(
            path=path,
            facts=read_facts(path),
            failed=read_failed(path),
            kept_failures=tuple(one.seed for one in read_manifest(path) if one.success_step is None),
            seconds=seconds,
        )

    @property
    def n_bytes(self) -> int:
        """Size of its files."""
        return sum(file.n_bytes for file in self.facts.files.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPart:
    """What one part of a recording has of a task: `n_episodes` of `n_total`."""

    task: str
    n_episodes: int
    n_total: int
    seconds: float  # of this call


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSummary:
    """What one call of `record` has made: of a part no datasets, and fewer than tasks if it was stopped."""

    out: Path
    datasets: tuple[RecordedDataset, ...]
    was_stopped: bool
    parts: tuple[RecordedPart, ...] = ()


class _Stopped(Exception):
    """The observer asked to stop."""


def record(
    recipe: DatasetRecipe,
    *,
    out: Path,
    command: str = "",
    allow_environment_change: bool = False,
    observer: RecordingObserver | None = None,
    selections: Mapping[str, Selection] | None = None,
    source: str | None = None,
    backend: Backend = LOCAL,
    part: Shard | None = None,
) -> RecordingSummary:
    """Record all datasets of a recipe that are not there yet, in OUT/TASK.

    Args:
        recipe: what to record.
        out: the folder.
        command: what the user typed, for the record.
        allow_environment_change: resume although package versions or the machine have changed.
        observer: gets the progress.
        selections: task -> the attempts to render, where they are known already.
        source: digest of what the selections were read from.
        backend: where the workers run; they write shards and datasets into the folder.
        part: render only this part of the episodes; `merge_recordings` makes the datasets.

    Raises:
        VlaEvalError: a mistake in the recipe, a recording that cannot resume, a full disk.
    """
    plan = plan_recording(recipe)
    recipe = plan.recipe
    refuse_missing_gpu(backend.n_gpus, {"render.backend": recipe.render.backend})
    preload = (WORKER_MODULE, *slow_modules(one.group.env for one in plan.tasks))
    if not out.exists():
        backend.prepare(preload)
    part = part and part.of_blocks(recipe.episodes_per_shard, recipe.episodes)
    versions = {one.task: one.task_version for one in plan.tasks}
    description = RunDescription(
        name=recipe.name,
        config={**content_of(recipe, options=OPTION_FIELDS), "task_versions": versions, "source": source},
        recipes=plan.recipe_files,
        environment=collect_environment(),
        options=options_of(recipe, options=OPTION_FIELDS),
        command=command,
        shard=part,
    )
    datasets: list[RecordedDataset] = []
    parts: list[RecordedPart] = []
    n_workers = backend.n_cores if recipe.workers == "auto" else recipe.workers
    with RecordingFolder.open(out, description, allow_environment_change=allow_environment_change) as folder:
        spec = WorkerSpec(
            runner=RunnerClass(target=f"{WORKER_MODULE}:RecordingRunner"),
            answers=(Attempt, Path, DatasetFacts),
            timeouts=recipe.timeouts,
            logs=folder.logs(),
            preload=preload,
        )
        pool: RecordingPool = backend.pool(spec, size=n_workers)
        with pool as running:
            recorder = _Recorder(
                folder=folder,
                pool=running,
                observer=observer or _Silence(),
                allow_environment_change=allow_environment_change,
            )
            try:
                for task in plan.tasks:
                    if part is None:
                        datasets.append(recorder.record(task, (selections or {}).get(task.task)))
                    else:
                        parts.append(recorder.record_part(task, part))
                was_stopped = False
            except _Stopped:
                was_stopped = True
    return RecordingSummary(out=out, datasets=tuple(datasets), was_stopped=was_stopped, parts=tuple(parts))


@dataclass(slots=True, kw_only=True)
class _Recorder:
    folder: RecordingFolder
    pool: RecordingPool
    observer: RecordingObserver
    allow_environment_change: bool

    def record(self, task: TaskPlan, selection: Selection | None) -> RecordedDataset:
        begun = time.monotonic()
        path = self.folder.out / task.task
        if not (path / RECORDING_FILE).exists():  # a dataset appears only when it is complete
            selection = selection or self._try_seeds(task)
            shards = self._shard_jobs(task, selection)
            self._render(shards)
            self._join(task, selection, shards)
        remove_shards(self.folder.out, task.task)  # also what a killed session has left
        return RecordedDataset.read(path, seconds=time.monotonic() - begun)

    def record_part(self, task: TaskPlan, part: Shard) -> RecordedPart:
        """Try all seeds, since each decides on the others, and render the part's share of the episodes."""
        begun = time.monotonic()
        jobs = self._shard_jobs(task, self._try_seeds(task))
        own = [job for job in jobs if part.holds(job.first_index)]
        self._render(own)
        return RecordedPart(
            task=task.task,
            n_episodes=sum(len(job.attempts) for job in own),
            n_total=task.recipe.episodes,
            seconds=time.monotonic() - begun,
        )

    def _shard_jobs(self, task: TaskPlan, selection: Selection) -> tuple[ShardJob, ...]:
        return shard_jobs(task, selection.kept, functools.partial(self.folder.shard, task.task))

    def _try_seeds(self, task: TaskPlan) -> Selection:
        queue = SeedQueue(task, self.folder.attempts(task.task))
        self._begin(task, "trying seeds", n_done=queue.n_kept)
        for _, answer in self._answers(queue):
            assert isinstance(answer, Attempt)
            self.folder.append(task.task, answer)
            queue.add(answer)
            self.observer.on_progress(n_done=queue.n_kept)
        return queue.selection()

    def _render(self, jobs: Sequence[ShardJob]) -> None:
        open_jobs = [job for job in jobs if not job.path.exists()]
        n_total = sum(len(job.attempts) for job in jobs)
        n_done = n_total - sum(len(job.attempts) for job in open_jobs)
        self.observer.on_phase(jobs[0].plan.task, "rendering", n_done=n_done, n_total=n_total)
        for done, _ in self._answers(JobList(open_jobs)):
            assert isinstance(done, ShardJob)
            n_done += len(done.attempts)
            self.observer.on_progress(n_done=n_done)

    def _join(self, task: TaskPlan, selection: Selection, shards: Sequence[ShardJob]) -> None:
        self._begin(task, "joining", n_done=0)
        path = self.folder.out / task.task
        path.parent.mkdir(exist_ok=True)  # the id may have a namespace
        job = join_job(task, path, shards=shards, failed=selection.failed, run_file=self.folder.run_file)
        for _ in self._answers(JobList([job])):
            self.observer.on_progress(n_done=task.recipe.episodes)

    def _answers(
        self, queue: SeedQueue | JobList[ShardJob] | JobList[JoinJob]
    ) -> Iterable[tuple[RecordingJob, RecordingAnswer]]:
        """Run the jobs, each again if it fails once; yield each with its answer when it is done."""
        n_failed: Counter[str] = Counter()
        for event in self.pool.run(queue):
            if not isinstance(event, Answered):
                if isinstance(event, DeviceFound):
                    self.folder.note_device(event.device, allow_change=self.allow_environment_change)
                elif event is None and self.observer.on_tick():
                    raise _Stopped
                continue
            job, answer = event.job, event.answer
            if isinstance(answer, Failed):
                n_failed[job.name] += 1
                _raise_if_last(answer, n_failed[job.name], job.name)
                queue.give_back(job)  # type: ignore[arg-type]  # it is the queue's own
            else:
                yield job, answer

    def _begin(self, task: TaskPlan, phase: Phase, *, n_done: int) -> None:
        self.observer.on_phase(task.task, phase, n_done=n_done, n_total=task.recipe.episodes)


def _raise_if_last(failed: Failed, n_failed: int, name: str) -> None:
    if failed.refused:
        raise as_exception(failed.error)
    if n_failed >= MAX_TRIES:
        error = failed.error
        raise RecordingError(
            f"{name}: failed {MAX_TRIES} times, the last time during {error.stage}: {error.kind}: "
            f"{error.message}\n{error.details or ''}\nWhat was recorded is kept; the same command resumes."
        )
