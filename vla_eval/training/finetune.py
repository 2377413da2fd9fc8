"""Fine-tune: recipe and dataset in, a run folder with checkpoints out. The same call resumes it."""

import contextlib
import ctypes
import functools
import hashlib
import os
import secrets
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vla_eval.checkpoints.files import checkpoint_sha256
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.data.exact_statistics import about_still_dimensions
from vla_eval.models.shared.sentence_reading import SentenceReading, SentenceWatch
from vla_eval.storage.provenance import collect_environment
from vla_eval.training.cost.estimate import RateWatch, estimate
from vla_eval.training.dataset import about_decisions, about_failures
from vla_eval.training.extension import check_steps
from vla_eval.training.held_out import METRIC_KEY, HeldOut, asked_warnings, shared_seeds_warning
from vla_eval.training.job import TrainingJob, training_job
from vla_eval.training.loop import Listeners, train
from vla_eval.training.policy_config import masks_padding
from vla_eval.training.request import FinetuneSummary, compared_fields, request_sha256
from vla_eval.training.run_folder import (
    LOCK_FILE,
    REQUEST_KEY,
    append_metrics,
    newest_step,
    open_folder,
    opened,
    read_metrics,
    read_record,
    whole_checkpoints,
)
from vla_eval.training.trackers import Services, services

RUN_ID = "run_id"  # of `finetune.json`
Say = Callable[[str], None]
"""Takes a line for a person."""
IsStopping = Callable[[], bool]
"""Says whether to stop early."""


def finetune(
    config: FinetuneConfig,
    *,
    command: str = "",
    say: Say = lambda _line: None,
    is_stopping: IsStopping = lambda: False,
) -> FinetuneSummary:
    """Fine-tune, or resume a fine-tuning.

    `is_stopping` is asked between steps, and during evaluations; once it says yes, a checkpoint is written,
    from which the same call resumes.

    Raises:
        VlaEvalError: a mistake; what was saved stays.
    """
    job = training_job(config)
    if job.device == "cpu":
        keep_freed_memory()
    _describe(job, say)
    with _opened(job, config, command) as resume_from:
        job = replace(job, resume_from=resume_from, run_id=_run_id(job.out))
        say(f"run: {job.out}" + (f", resuming from step {job.first_step}" if job.resume_from else ""))
        with services(job, say) if _is_first_process() else contextlib.nullcontext(Services(say)) as tracked:
            held_out = _held_out(job, say, tracked, is_stopping)
            if held_out is not None:
                held_out.catch_up(read_metrics(job.out))
            is_finished = train(job, _listeners(job, say, tracked, held_out, is_stopping))
            if held_out is not None and held_out.missing(read_metrics(job.out)):
                is_finished = False
    summary = FinetuneSummary(out=job.out, step=newest_step(job.out), is_finished=is_finished)
    if is_finished and job.first_step == summary.step:
        say(str(summary))
    return summary


def _describe(job: TrainingJob, say: Say) -> None:
    dataset, frames = job.dataset, job.frames
    say(
        f"dataset: {dataset.name} {dataset.sha256[:12]}, {frames.n_used} of {frames.n_frames} frames as "
        "starts"
    )
    for line in about_still_dimensions(dataset.meta.stats, dataset.meta.features):
        say(line)
    if dataset.failed:
        say(about_failures(dataset))
    if (told := about_decisions(dataset, job.policy)) is not None:
        say(told)
    if len(dataset.facts.tasks) > 1:
        say(f"tasks: {', '.join(dataset.facts.tasks)}")
    warning = shared_seeds_warning(dataset)
    if warning is not None:
        say(warning)
    for line in asked_warnings(job.facts, job.held_out_task, policy=job.name):
        say(f"warning: {line}")
    if not masks_padding(job.policy):
        say(
            "padded actions: this policy does not mask them; chunks that go beyond an episode's end are left "
            "out"
        )


def _listeners(
    job: TrainingJob, say: Say, tracked: Services, held_out: HeldOut | None, is_stopping: IsStopping
) -> Listeners:
    """Return what gets the progress: a person, a tracker of metrics, the evaluation of checkpoints."""
    steps = job.recipe.steps

    watches: list[RateWatch] = []

    def describe(model: Any) -> None:  # Any: a torch module of lerobot's
        found = estimate(model, job.policy, job.recipe, device=job.device)
        watches.append(RateWatch(found, job.first_step, say))
        for line in found.model.lines():
            say(line)

    def time_step(step: int, seconds: float) -> None:
        if _is_first_process():
            watches[0].on_step(step, seconds)

    def report(line: Mapping[str, float]) -> None:
        seconds = line["update_s"] + line["dataloading_s"]
        say(
            f"step {int(line['step'])}/{steps}  loss {line['loss']:.4f}  lr {line['lr']:.2e}  "
            f"{seconds:.3f} s/step, {(steps - line['step']) * seconds / 60:.0f} min left"
        )
        tracked.log(line)

    def evaluate(checkpoint: Path) -> None:
        tracked.save(checkpoint)
        if held_out is not None and held_out.is_due(int(checkpoint.name)):
            held_out.evaluate(checkpoint)

    return Listeners(
        on_model=describe,
        on_sentence=_sentences(job, say),
        on_metrics=report,
        on_checkpoint=evaluate,
        on_step=time_step,
        is_stopping=is_stopping,
    )


def _sentences(job: TrainingJob, say: Say) -> Callable[[SentenceReading], None]:
    watch = SentenceWatch(job.name)

    def name(reading: SentenceReading) -> None:
        tasks = [task for task, own in job.dataset.sentences.items() if reading.sentence in own]
        for line in (line for task in tasks for line in watch.lines(reading, task)):
            if _is_first_process():
                say(f"warning: {line}")

    return name


def _held_out(job: TrainingJob, say: Say, tracked: Services, is_stopping: IsStopping) -> HeldOut | None:
    if job.held_out is None or job.held_out_task is None or not _is_first_process():
        return None

    def report(line: Mapping[str, float | str]) -> None:
        append_metrics(job.out, line)
        tracked.log(line, METRIC_KEY)

    return HeldOut(
        settings=job.held_out,
        task=job.held_out_task,
        out=job.out,
        last_step=job.recipe.steps,
        on_metrics=report,
        say=say,
        is_stopping=is_stopping,
    )


def _run_id(out: Path) -> str:
    """Return what names the run to services; runs of earlier versions have no such name."""
    known = read_record(out).get(RUN_ID)
    return str(known or hashlib.sha256(os.fsencode(out.resolve())).hexdigest()[:8])


def _is_first_process() -> bool:
    return os.environ.get("RANK", "0") == "0"  # of several that accelerate has started


def _open(job: TrainingJob, config: FinetuneConfig, command: str) -> Path | None:
    section = compared_fields(job.recipe)
    del section["failed_episodes"]  # its outcome is recorded below
    chosen = {"episodes_left_out": list(job.dataset.left_out)} if job.dataset.left_out else {}
    base_sha256 = None if job.base is None else checkpoint_sha256(job.base)
    settings: dict[str, Any] = {  # Any: plain data
        "finetune": section,
        "dataset": {"name": job.dataset.name, "sha256": job.dataset.sha256, **chosen},
        "run_seed": job.run_seed,
        "base_sha256": base_sha256,
    }
    record: dict[str, Any] = {  # Any: plain data
        "policy": job.name,
        "recipe_sha256": job.recipe_sha256,
        "dataset_was_replayed": job.dataset.was_replayed,
        "tasks": job.dataset.facts.tasks,
        "environment": collect_environment(),
        "command": command,
        REQUEST_KEY: request_sha256(job.recipe, job.dataset.root, base_sha256, run_seed=job.run_seed),
        RUN_ID: secrets.token_hex(4),
    }
    return open_folder(
        job.out,
        settings,
        record,
        check_steps=functools.partial(check_steps, job, config),
        ignore=frozenset({LOCK_FILE}),
    )


@contextlib.contextmanager
def _opened(job: TrainingJob, config: FinetuneConfig, command: str) -> Iterator[Path | None]:
    """Open the run folder, and give the checkpoint to resume from, None at the beginning."""
    if not _is_first_process():  # the first one has the lock, and checks
        yield next(reversed(whole_checkpoints(job.out)), None)
        return
    with opened(job.out, lambda: _open(job, config, command)) as resume_from:
        yield resume_from


# glibc's malloc.h
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
NEVER_BYTES = (1 << 31) - 1


def keep_freed_memory() -> bool:
    """Let malloc keep large blocks and free memory in the process; return whether it does.

    Without glibc (macOS, musl) nothing is changed. No result depends on it.
    """
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):
        return False
    return bool(libc.mallopt(M_MMAP_MAX, 0)) and bool(libc.mallopt(M_TRIM_THRESHOLD, NEVER_BYTES))
