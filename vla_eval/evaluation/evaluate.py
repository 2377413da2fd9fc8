"""Evaluate: plan the episodes, run those that have no result yet, store each as it comes.

Only this process writes results. An episode that cannot be run becomes an error record; a mistake that
every episode would repeat ends the run.
"""

import contextlib
import logging
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from vla_eval.config.evaluation import OPTION_FIELDS
from vla_eval.config.files import options_of
from vla_eval.envs.factory import slow_modules
from vla_eval.errors import TooManyErrorsError
from vla_eval.evaluation.episode_jobs import EpisodeJob, SetupKey
from vla_eval.evaluation.job_queue import EpisodeBatch, JobQueue
from vla_eval.evaluation.plan import Plan, make_plan
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.evaluation.server_phases import ReadyPhase, phases, with_servers
from vla_eval.evaluation.worker import Finished, MemoryFound, NetworkCompiled, SentenceRead
from vla_eval.models.shared.sentence_reading import SentenceWatch
from vla_eval.policies.registry import own_modules
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.records import EpisodeError, EpisodeKey, EpisodeRecord
from vla_eval.storage.provenance import collect_environment
from vla_eval.storage.run_folder import RunDescription, RunFolder, StoredEpisode
from vla_eval.viz.capture import EpisodeCapture
from vla_eval.workers.backend import Pool
from vla_eval.workers.inside import RunnerClass
from vla_eval.workers.jobs import Answered
from vla_eval.workers.load import Load
from vla_eval.workers.messages import DeviceFound, Failed, as_exception
from vla_eval.workers.process import WorkerSpec

WORKER_MODULE = "vla_eval.evaluation.worker"
RUNNER = f"{WORKER_MODULE}:EpisodeRunner"
LOAD_SECONDS = 1.0  # between two calls of `on_load`
MAX_SERVER_STARTS = 3  # of one policy, so that one that always dies ends in errors
EpisodePool = Pool[EpisodeBatch, Finished]

logger = logging.getLogger(__name__)


class EvaluationObserver:
    """Watches a run: progress on a terminal, for example. This one watches nothing and never stops it."""

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        """Called once, before the first episode."""

    def on_device(self, device: Mapping[str, str]) -> None:
        """Called when a worker's simulator is there, with the facts about its device."""

    def on_warning(self, line: str) -> None:
        """Called with what a person should know and the plan could not say: once per line."""

    def on_record(self, record: EpisodeRecord) -> None:
        """Called with each record once it is durable."""

    def on_load(self, load: Load) -> None:
        """Called about once a second, and before records, with what the workers are doing."""

    def on_tick(self) -> bool:
        """Called several times a second; returns whether the run has to stop now."""
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSummary:
    """The result of one call of `evaluate`.

    Attributes:
        n_open: episodes without a result: not run, or ended in an error.
        n_errors: how many ended in an error in this call.
        was_stopped: the observer asked to stop.
    """

    out: Path
    n_episodes: int
    n_open: int
    n_errors: int
    was_stopped: bool


def evaluate(
    resolved: ResolvedEvaluation,
    *,
    command: str = "",
    allow_environment_change: bool = False,
    observer: EvaluationObserver | None = None,
) -> EvaluationSummary:
    """Run all episodes of an evaluation that have no result yet; `command` is what the user typed.

    `allow_environment_change` continues although package versions or the machine have changed.

    Raises:
        VlaEvalError: a mistake that every episode would repeat; `TooManyErrorsError` if so many
            episodes in a row ended in an error; errors of the store. Records that are stored stay.
    """
    observer, path, plan = observer or EvaluationObserver(), resolved.out, make_plan(resolved)
    if not path.exists():  # else nothing may be left to run
        resolved.backend.prepare(_modules(plan))
    with RunFolder.open(
        path,
        describe(resolved, plan, command),
        allow_environment_change=allow_environment_change,
        groups={job.group.key for job in plan.jobs},
    ) as folder:
        finished = folder.finished_keys()
        queue = JobQueue(plan.jobs, finished=finished)
        n_open = queue.n_episodes
        n_workers = worker_count(resolved, plan, n_jobs=queue.n_batches)
        observer.on_start(plan, n_finished=len(plan.jobs) - n_open, n_workers=n_workers)
        bookkeeper = _Bookkeeper(folder=folder, resolved=resolved, observer=observer, queue=queue)
        was_stopped = bool(n_open) and _run_phases(plan, bookkeeper, finished)
    return EvaluationSummary(
        out=path,
        n_episodes=len(plan.jobs),
        n_open=n_open - bookkeeper.n_results,
        n_errors=bookkeeper.n_errors,
        was_stopped=was_stopped,
    )


def worker_count(resolved: ResolvedEvaluation, plan: Plan, *, n_jobs: int) -> int:
    """Return how many workers to start."""
    asked = resolved.config.workers
    if asked != "auto":
        return max(1, min(asked, n_jobs))
    n_cores = resolved.backend.n_cores
    return max(1, min(n_cores, n_jobs, plan.max_workers or n_cores))


def describe(resolved: ResolvedEvaluation, plan: Plan, command: str) -> RunDescription:
    """Return the run's description, for `run.json`."""
    return RunDescription(
        name=resolved.config.name,
        config={
            **resolved.results_config,
            "policy_names": list(plan.policy_names),
            "task_versions": dict(plan.task_versions),
        },
        recipes=dict(plan.recipe_hashes),
        environment=collect_environment(),
        options=options_of(resolved.config, options=OPTION_FIELDS),
        command=command,
        normalization=dict(plan.normalization),
        servers=dict(plan.servers),
        shard=plan.shard,
        training_seeds=plan.training_seeds,
    )


def _modules(plan: Plan) -> tuple[str, ...]:
    """Return the slow imports of workers, except other packages' code, which may not work after a fork."""
    adapters = dict.fromkeys(job.group.adapter for job in plan.jobs)
    if plan.shared:
        adapters[REMOTE_ADAPTER] = None
    return (WORKER_MODULE, *slow_modules(job.group.env for job in plan.jobs), *own_modules(adapters))


def _run_phases(plan: Plan, bookkeeper: "_Bookkeeper", finished: Collection[EpisodeKey]) -> bool:
    """Run the episodes that have no result; return whether the observer stopped it."""
    logs, resolved = bookkeeper.folder.path / "logs", bookkeeper.resolved
    logs.mkdir(exist_ok=True)
    spec = WorkerSpec(
        runner=_runner(bookkeeper),
        answers=(Finished,),
        timeouts=resolved.config.timeouts,
        logs=logs,
        preload=_modules(plan),
    )
    for phase in phases(plan):
        if not JobQueue(phase.jobs, finished=finished).n_episodes:
            continue
        stops = bookkeeper.observer.on_tick
        for n_starts in range(1, MAX_SERVER_STARTS + 1):
            with with_servers(phase, resolved, plan, logs=logs, stops=stops) as ready:
                if ready is None:
                    return True
                for found in () if ready.servers is None else ready.servers.compiled:
                    bookkeeper.folder.note(found.note(phase.policy or ""))
                bookkeeper.queue = JobQueue(ready.jobs, finished={*finished, *bookkeeper.keys})
                size = worker_count(resolved, plan, n_jobs=bookkeeper.queue.n_batches)
                pool: EpisodePool = resolved.backend.pool(spec, size=size)
                ending = _run(ready, bookkeeper, pool, is_last_start=n_starts == MAX_SERVER_STARTS)
            if ending == "stopped":
                return True
            if ending == "finished":
                break
    return False


def _runner(bookkeeper: "_Bookkeeper") -> RunnerClass:
    config = bookkeeper.resolved.config
    path = bookkeeper.folder.path.resolve()
    capture = None
    if config.capture.is_on:
        capture = EpisodeCapture(config=config.capture, folder=path, seed_start=config.seed_start)
    asks_memory = config.world is not None and config.memory_change is None
    options = {
        "capture": capture,
        "asks_memory": asks_memory,
        "memories_in": path if config.capture.memory else None,
        "frames_in": path if config.capture.frames else None,
    }
    return RunnerClass(target=RUNNER, options=options)


def _run(
    phase: ReadyPhase, bookkeeper: "_Bookkeeper", pool: EpisodePool, *, is_last_start: bool
) -> Literal["finished", "stopped", "server lost"]:
    """Run the queue's episodes until they are finished, the observer stops it, or a server has died."""
    next_load = time.monotonic()
    with contextlib.ExitStack() as ending, pool as running:
        ending.callback(bookkeeper.store)  # what has come, whatever ends the run
        for event in running.run(bookkeeper.queue):
            if isinstance(event, Answered):
                failed = event.answer if isinstance(event.answer, Failed) else None
                if failed and not is_last_start and phase.lost_its_server(failed.error):
                    logger.warning("a policy server has died; it is started again: %s", failed.error.message)
                    return "server lost"
                bookkeeper.take(event)
            elif isinstance(event, DeviceFound):
                bookkeeper.folder.note_device(event.device)
                bookkeeper.observer.on_device(event.device)
            elif isinstance(event, NetworkCompiled):
                bookkeeper.folder.note(event.note)
            elif isinstance(event, MemoryFound):
                bookkeeper.folder.note_memory(event.policy, event.parts)
            elif isinstance(event, SentenceRead):
                bookkeeper.note_sentence(event)
            else:
                # Before records are handed out: their steps are no longer among those under way.
                if bookkeeper.unstored or time.monotonic() >= next_load:
                    next_load = time.monotonic() + LOAD_SECONDS
                    bookkeeper.observer.on_load(running.load())
                bookkeeper.store()
                if bookkeeper.observer.on_tick():
                    return "stopped"
    return "finished"


@dataclass(slots=True, kw_only=True)
class _Bookkeeper:
    """Stores what comes from the workers, and decides when to give up."""

    folder: RunFolder
    resolved: ResolvedEvaluation
    observer: EvaluationObserver
    queue: JobQueue
    n_results: int = 0
    n_errors: int = 0
    n_consecutive_errors: int = 0
    proven: set[SetupKey] = field(default_factory=set)  # groups with an episode that ran to its end
    keys: set[EpisodeKey] = field(default_factory=set)  # of the episodes that were stored in this call
    kinds: set[str] = field(default_factory=set)  # of machines that are unlike this one
    unstored: list[StoredEpisode] = field(default_factory=list)
    sentences: dict[str, SentenceWatch] = field(default_factory=dict)  # by `EpisodeGroup.part`

    def take(self, answered: Answered[EpisodeBatch, Finished]) -> None:
        """Store the results, or the error in their place."""
        batch, answer = answered.job, answered.answer
        if isinstance(answer, Failed):
            # A group that has worked before is not a user's mistake: a GPU was lost, for example.
            if answer.refused and batch.setup_key not in self.proven:
                raise as_exception(answer.error)
            if len(batch.jobs) > 1:
                self.queue.put_back_alone(batch)
            else:
                self._take_error(batch.jobs[0], answer.error)
            return
        self.proven.add(batch.setup_key)
        self.n_consecutive_errors = 0
        kind = answered.kind
        if kind is not None and kind.name not in self.kinds:
            self.folder.note_machine(kind.name, kind.facts)
            self.kinds.add(kind.name)
        for record, timing in zip(answer.records, answer.timings, strict=True):
            if kind is not None:
                timing = replace(timing, kind=kind.name)
            self.unstored.append(StoredEpisode(record, timing))

    def store(self) -> None:
        """Make all that has come since the last tick durable at once: a disk waits once for all of them."""
        stored, self.unstored = self.unstored, []
        if not stored:
            return
        self.folder.append_all(stored)
        for record, _ in stored:
            self.keys.add(record.key)
            self.n_results += record.error is None
            self.n_errors += record.error is not None
            self.observer.on_record(record)

    def note_sentence(self, found: SentenceRead) -> None:
        """Say what was cut of a sentence, and which tasks became one; all workers find it."""
        watch = self.sentences.setdefault(found.part, SentenceWatch(found.part))
        for line in watch.lines(found.reading, found.task):
            self.folder.note(line)
            self.observer.on_warning(line)

    def _take_error(self, job: EpisodeJob, error: EpisodeError) -> None:
        record = EpisodeRecord(**job.key._asdict(), outcome="error", error=error)
        self.unstored.append(StoredEpisode(record, None))
        self.n_consecutive_errors += 1
        if self.n_consecutive_errors >= self.resolved.config.max_consecutive_errors:
            raise TooManyErrorsError(
                f"{self.n_consecutive_errors} episodes in a row ended in an error (max_consecutive_errors). "
                f"The last: {job.key.policy} on {job.key.task}, seed {job.key.seed}: {error.kind} during "
                f"{error.stage}: {error.message} All results are kept in {self.folder.path}; the same "
                f"command retries the errors."
            )
