"""Evaluate: plan the episodes, run those that have no result yet, store each as it comes.

Only this process writes results. An episode that cannot be run becomes an error record and the next
one is run; a mistake that every episode would repeat ends the run. Stopped at any moment, by any
means, the same call resumes where it stopped.
"""

import functools
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from vla_eval.config.evaluation import OPTION_FIELDS, EvalConfig
from vla_eval.config.files import options_of
from vla_eval.errors import TooManyErrorsError
from vla_eval.evaluation.inference_choice import with_inference
from vla_eval.evaluation.job_queue import EpisodeBatch, JobQueue
from vla_eval.evaluation.phases import phases, with_servers
from vla_eval.evaluation.plan import (
    EpisodeJob,
    Plan,
    SetupKey,
    fingerprint,
    results_config,
)
from vla_eval.evaluation.sharding import plan_shard
from vla_eval.evaluation.worker import Finished, worker_main
from vla_eval.policies.registry import own_modules
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.records import EpisodeError, EpisodeKey, EpisodeRecord
from vla_eval.storage.provenance import collect_environment
from vla_eval.storage.run_folder import RunDescription, RunFolder
from vla_eval.storage.shard import Shard, shard_folder
from vla_eval.viz.capture import EpisodeCapture
from vla_eval.workers.backend import Backend, Pool
from vla_eval.workers.jobs import Answered
from vla_eval.workers.local import LOCAL
from vla_eval.workers.messages import DeviceFound, Failed, as_exception
from vla_eval.workers.process import WorkerMain
from vla_eval.workers.start import simulator_modules

RUNS_FOLDER = Path("runs")
FINGERPRINT_DIGITS = 8
WORKER_MODULE = "vla_eval.evaluation.worker"
EpisodePool = Pool[EpisodeBatch, Finished]


class EvaluationObserver(Protocol):
    """Watches a run: progress on a terminal, for example."""

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        """Called once, before the first episode."""

    def on_record(self, record: EpisodeRecord) -> None:
        """Called with each record once it is durable."""

    def on_tick(self) -> bool:
        """Called several times a second; returns whether the run has to stop now."""


class _Silence:
    """Watches nothing and never stops the run."""

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        """Do nothing."""

    def on_record(self, record: EpisodeRecord) -> None:
        """Do nothing."""

    def on_tick(self) -> bool:
        """Do not stop."""
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSummary:
    """The result of one call of `evaluate`.

    Attributes:
        out: the run folder.
        n_episodes: how many episodes the run has in all.
        n_open: how many of them have no result: not run, or ended in an error.
        n_errors: how many ended in an error in this call.
        was_stopped: the observer asked to stop.
    """

    out: Path
    n_episodes: int
    n_open: int
    n_errors: int
    was_stopped: bool


def default_run_folder(config: EvalConfig) -> Path:
    """Return the folder that a configuration's results go to: the same for the same configuration."""
    return RUNS_FOLDER / f"{config.name}-{fingerprint(config)[:FINGERPRINT_DIGITS]}"


def evaluate(
    config: EvalConfig,
    *,
    out: Path | None = None,
    command: str = "",
    allow_environment_change: bool = False,
    observer: EvaluationObserver | None = None,
    backend: Backend = LOCAL,
    shard: Shard | None = None,
) -> EvaluationSummary:
    """Run all episodes of a configuration that have no result yet.

    Args:
        config: what to evaluate.
        out: the run folder; by default `default_run_folder(config)`, or that of its shard.
        command: what the user typed, for the record.
        allow_environment_change: continue although package versions or the machine have changed.
        observer: gets the progress.
        backend: where the workers run.
        shard: run only this part of the episodes.

    Raises:
        VlaEvalError: a mistake that every episode would repeat; `TooManyErrorsError` if so many
            episodes in a row ended in an error; errors of the store. Records that are stored stay.
    """
    config = with_inference(config, backend)
    observer, path = observer or _Silence(), out or shard_folder(default_run_folder(config), shard)
    plan = plan_shard(config, shard)
    with RunFolder.open(
        path,
        _describe(config, plan, command),
        allow_environment_change=allow_environment_change,
        groups={job.group.key for job in plan.jobs},
    ) as folder:
        finished = folder.finished_keys()
        queue = JobQueue(plan.jobs, finished=finished)
        n_open = queue.n_episodes
        n_workers = worker_count(config, plan, n_jobs=queue.n_batches, backend=backend)
        observer.on_start(plan, n_finished=len(plan.jobs) - n_open, n_workers=n_workers)
        bookkeeper = _Bookkeeper(folder=folder, path=path, config=config, observer=observer, queue=queue)
        was_stopped = bool(n_open) and _run_phases(plan, bookkeeper, finished, backend)
    return EvaluationSummary(
        out=path,
        n_episodes=len(plan.jobs),
        n_open=n_open - bookkeeper.n_results,
        n_errors=bookkeeper.n_errors,
        was_stopped=was_stopped,
    )


def worker_count(config: EvalConfig, plan: Plan, *, n_jobs: int, backend: Backend = LOCAL) -> int:
    """Return how many workers to start."""
    if config.workers != "auto":
        return max(1, min(config.workers, n_jobs))
    n_cores = backend.n_cores
    return max(1, min(n_cores, n_jobs, plan.max_workers or n_cores))


def _describe(config: EvalConfig, plan: Plan, command: str) -> RunDescription:
    return RunDescription(
        name=config.name,
        config={
            **results_config(config),
            "policy_names": list(plan.policy_names),
            "task_versions": dict(plan.task_versions),
        },
        recipes=dict(plan.recipe_hashes),
        environment=collect_environment(),
        options=options_of(config, options=OPTION_FIELDS),
        command=command,
        normalization=dict(plan.normalization),
        servers=dict(plan.servers),
        shard=plan.shard,
    )


def _modules(config: EvalConfig, plan: Plan) -> tuple[str, ...]:
    """Return the slow imports of workers, except other packages' code, which may not work after a fork."""
    adapters = dict.fromkeys(job.group.adapter for job in plan.jobs)
    if plan.shared:
        adapters[REMOTE_ADAPTER] = None
    return (WORKER_MODULE, *simulator_modules(config.simulator), *own_modules(adapters))


def _run_phases(
    plan: Plan, bookkeeper: "_Bookkeeper", finished: Collection[EpisodeKey], backend: Backend
) -> bool:
    """Run the episodes that have no result; return whether the observer stopped it."""
    logs, config = bookkeeper.path / "logs", bookkeeper.config
    logs.mkdir(exist_ok=True)
    for phase in phases(plan):
        if not JobQueue(phase.jobs, finished=finished).n_episodes:
            continue
        stops = bookkeeper.observer.on_tick
        with with_servers(phase, config, plan, backend=backend, logs=logs, stops=stops) as jobs:
            if jobs is None:
                return True
            queue = bookkeeper.queue = JobQueue(jobs, finished=finished)
            pool: EpisodePool = backend.pool(
                _worker_main(bookkeeper),
                answers=(Finished,),
                size=worker_count(config, plan, n_jobs=queue.n_batches, backend=backend),
                timeouts=config.timeouts,
                logs=logs,
                preload=_modules(config, plan),
            )
            if _run(queue, bookkeeper, pool):
                return True
    return False


def _worker_main(bookkeeper: "_Bookkeeper") -> WorkerMain:
    """Return what workers run."""
    config = bookkeeper.config
    if not config.capture.is_on:
        return worker_main
    folder = bookkeeper.path.resolve()
    capture = EpisodeCapture(config=config.capture, folder=folder, seed_start=config.seed_start)
    return functools.partial(worker_main, capture=capture)


def _run(queue: JobQueue, bookkeeper: "_Bookkeeper", pool: EpisodePool) -> bool:
    """Run the queue's episodes; return whether the observer stopped it."""
    with pool as running:
        for event in running.run(queue):
            if isinstance(event, Answered):
                bookkeeper.take(event)
            elif isinstance(event, DeviceFound):
                bookkeeper.folder.note_device(event.device)
            elif bookkeeper.observer.on_tick():
                return True
    return False


@dataclass(slots=True, kw_only=True)
class _Bookkeeper:
    """Stores what comes from the workers, and decides when to give up."""

    folder: RunFolder
    path: Path
    config: EvalConfig
    observer: EvaluationObserver
    queue: JobQueue
    n_results: int = 0
    n_errors: int = 0
    n_consecutive_errors: int = 0
    proven: set[SetupKey] = field(default_factory=set)  # groups with an episode that ran to its end

    def take(self, answered: Answered[EpisodeBatch, Finished]) -> None:
        """Store the results, or the error in their place."""
        batch, answer = answered.job, answered.answer
        if isinstance(answer, Failed):
            # A group that has worked before is no mistake of the user: a GPU was lost, for example.
            if answer.refused and batch.setup_key not in self.proven:
                raise as_exception(answer.error)
            if len(batch.jobs) > 1:
                self.queue.put_back_alone(batch)
            else:
                self._take_error(batch.jobs[0], answer.error)
            return
        self.proven.add(batch.setup_key)
        self.n_consecutive_errors = 0
        for record, timing in zip(answer.records, answer.timings, strict=True):
            self.folder.append(record, timing)
            self.n_results += 1
            self.observer.on_record(record)

    def _take_error(self, job: EpisodeJob, error: EpisodeError) -> None:
        record = EpisodeRecord(**job.key._asdict(), outcome="error", error=error)
        self.folder.append(record)
        self.n_errors += 1
        self.n_consecutive_errors += 1
        self.observer.on_record(record)
        if self.n_consecutive_errors >= self.config.max_consecutive_errors:
            raise TooManyErrorsError(
                f"{self.n_consecutive_errors} episodes in a row ended in an error (max_consecutive_errors). "
                f"The last: {job.key.policy} on {job.key.task}, seed {job.key.seed}: {error.kind} during "
                f"{error.stage}: {error.message} All results are kept in {self.path}; the same command "
                f"retries the errors."
            )
