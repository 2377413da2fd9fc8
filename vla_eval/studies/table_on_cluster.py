"""Fine-tunings of a table side by side on a cluster, each in a process of its own."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from vla_eval.config.evaluation import TimeoutConfig
from vla_eval.errors import FolderInUseError, TrainingError
from vla_eval.evaluation.model_table import Finetuning
from vla_eval.strict.bounds import MAX_SECONDS
from vla_eval.training.finetune_jobs import RUNNER, Finetuned, FinetuneJob
from vla_eval.workers.backend import Backend, Pool
from vla_eval.workers.inside import RunnerClass
from vla_eval.workers.jobs import Answered, JobList
from vla_eval.workers.messages import Failed
from vla_eval.workers.process import WorkerSpec

TINY_RUNNER = "vla_eval.testing.tiny_models:tiny_finetune_runner"
MAX_TRIES = 2  # of one fine-tuning, since a machine may hiccup; each resumes from its last checkpoint


def finetune_on(
    backend: Backend,
    todo: Sequence[Finetuning],
    *,
    logs: Path,
    is_tiny: bool,
    command: str,
    say: Callable[[str], None],
    is_stopping: Callable[[], bool],
) -> bool:
    """Run the fine-tunings; a GPU each, where there are GPUs. Return False if asked to stop.

    `logs` is a folder on storage that all machines share. `is_tiny` builds lerobot's π0 in its tiny form.
    """
    logs.mkdir(parents=True, exist_ok=True)
    jobs = [FinetuneJob(config=one.config, command=command, name=one.name) for one in todo]
    timeouts = TimeoutConfig(setup_seconds=MAX_SECONDS)
    runner = RunnerClass(target=TINY_RUNNER if is_tiny else RUNNER)
    spec = WorkerSpec(runner=runner, answers=(Finetuned,), timeouts=timeouts, logs=logs)
    size = max(1, min(len(jobs), backend.n_gpus or backend.n_cores))
    pool: Pool[FinetuneJob, Finetuned] = backend.pool(spec, size=size, takes_gpu=True)
    failed = _run(pool, JobList(jobs), n_jobs=len(jobs), say=say, is_stopping=is_stopping)
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
    queue: JobList[FinetuneJob],
    *,
    n_jobs: int,
    say: Callable[[str], None],
    is_stopping: Callable[[], bool],
) -> list[str] | None:
    """Run the jobs; return a sentence about each that failed, or None if it was asked to stop."""
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
            say(f"[{n_done}/{n_jobs}] {job.name}: {_outcome(answer)}")
    return failed


def _outcome(answer: Finetuned | Failed) -> str:
    if isinstance(answer, Finetuned):
        return "finished"
    if answer.error.kind == FolderInUseError.__name__:
        return "another process is training it"
    return f"{answer.error.kind}: {answer.error.message:.200}"
