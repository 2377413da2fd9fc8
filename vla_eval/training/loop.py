"""The training loop; `lerobot-train --resume` continues from its checkpoints.

All noise of a step is drawn from (run seed, step, process): a resumed run gives the same weights.
"""

import contextlib
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from pprint import pformat
from typing import Any  # lerobot and accelerate are untyped

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs, DistributedType
from lerobot.common.train_utils import (
    load_fsdp_optimizer_state,
    load_training_batch_size,
    load_training_num_processes,
)
from lerobot.datasets import EpisodeAwareSampler
from lerobot.datasets.factory import make_dataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.utils.collate import lerobot_collate_fn
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import has_method, init_logging
from tqdm import tqdm

from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.data.frames.remembered_frames import RememberedFramesDataset
from vla_eval.errors import TrainingError
from vla_eval.models.shared.images import in_numbers
from vla_eval.models.shared.sentence_reading import SentenceReading
from vla_eval.models.shared.tokens_read import Readings
from vla_eval.policies.lerobot.device import amp_dtype
from vla_eval.training.batches import SeededSamples, Sharing, StepBatches, on_device, preprocessed
from vla_eval.training.checkpoints import load_loss_scale, load_state, write_checkpoint
from vla_eval.training.job import TrainingJob, lerobot_config
from vla_eval.training.micro_batches import add_gradient
from vla_eval.training.model import local_files_only, make_model, make_processors
from vla_eval.training.run_folder import LOG_FILE, append_metrics, drop_extra_checkpoints
from vla_eval.workers.start import child_context

LAUNCHED_PRECISION = "ACCELERATE_MIXED_PRECISION"  # set by `accelerate launch --mixed_precision=…`
LAUNCHED = {"bf16": torch.bfloat16, "fp16": torch.float16}
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
REDUCTIONS = {
    **{"loss": "mean", "grad_norm": "none", "lr": "none", "update_s": "max", "dataloading_s": "max"},
    **{"samples_per_s": "none", "gpu_mem_gb": "max"},
}
"""What is measured -> how the numbers of several processes become one; those of a policy's own are means."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Listeners:
    """Who gets the progress of a training."""

    on_model: Callable[[Any], None]  # called with the model before its optimizer is made
    # called with what the policy has read of each sentence, after the first step that has it
    on_sentence: Callable[[SentenceReading], None]
    on_metrics: Callable[[Mapping[str, float]], None]  # called with each line of metrics
    # called with the folder of each checkpoint (`…/000100`) once it is there
    on_checkpoint: Callable[[Path], None]
    # called with each step, counted from 1, and its seconds, loading included
    on_step: Callable[[int, float], None]
    # asked between steps; once it says yes, a checkpoint is written and training ends
    is_stopping: Callable[[], bool]


def train(job: TrainingJob, listeners: Listeners) -> bool:
    """Train to the job's last step; a finished job is left as it is. False if training was asked to stop."""
    recipe = job.recipe
    if job.first_step >= recipe.steps:
        return True
    accelerator = Accelerator(
        # One process may train in several precisions, and accelerate has one for all: see `autocast_dtype`.
        mixed_precision="no",
        step_scheduler_with_optimizer=False,  # else once per process
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
        cpu=job.device == "cpu",
    )
    with _logging(job.out / LOG_FILE, accelerator), local_files_only(job):
        training = _Training(job, accelerator, listeners.on_model)
        is_main = accelerator.is_main_process
        silent = not (is_main and sys.stderr.isatty())
        is_saved = is_finished = True
        for step in tqdm(range(job.first_step + 1, recipe.steps + 1), desc="Training", disable=silent):
            if _is_asked_to_stop(accelerator, listeners):
                if not is_saved:
                    _save(training, step - 1, listeners)
                is_finished = False
                break
            started = time.perf_counter()
            for reading in training.do_step(step):
                listeners.on_sentence(reading)
            listeners.on_step(step, time.perf_counter() - started)
            if step % recipe.log_every_steps == 0:
                line = next_line(training.tracker, recipe.batch_size * accelerator.num_processes)
                if is_main:
                    _report(line, job.out, listeners)
            is_saved = step % recipe.save_every_steps == 0 or step == recipe.steps
            if is_saved:
                _save(training, step, listeners)
        logging.info("End of training" if is_finished else "Stopped, as asked")
        accelerator.end_training()
    return is_finished


class _Training:
    """The state that steps change, made or loaded in lerobot's order, which fixes the random draws."""

    def __init__(self, job: TrainingJob, accelerator: Accelerator, on_model: Callable[[Any], None]) -> None:
        self.job, self.accelerator, self.config = job, accelerator, lerobot_config(job)
        logging.info(pformat(self.config.to_dict()))
        torch.backends.cudnn.benchmark = True
        torch.backends.cuda.matmul.allow_tf32 = True
        with accelerator.main_process_first():  # the others find the decoded frames
            dataset = dataset_of(job, self.config)
        self.images = getattr(dataset, "image_fields", dataset.meta.camera_keys)
        self.tracker, self.readings = new_tracker(job, dataset, accelerator), Readings()
        set_seed(job.run_seed)
        model = make_model(job, dataset.meta)
        self.before, self.after = make_processors(job, model, dataset.meta)
        on_model(model)
        optimizer, scheduler = make_optimizer_and_scheduler(self.config, model)
        is_sharded = accelerator.distributed_type == DistributedType.FSDP
        if job.resume_from is not None:
            load_state(job.resume_from, optimizer, scheduler, load_optimizer=not is_sharded)
        loader = loader_of(job, self.config, dataset, accelerator)
        self.policy, self.optimizer, self.scheduler = accelerator.prepare(model, optimizer, scheduler)
        if job.resume_from is not None and is_sharded:
            load_fsdp_optimizer_state(self.policy, self.optimizer, job.resume_from)
        self.batches = on_device(loader, accelerator.device)
        self.autocast = autocast_dtype(job.policy, job.device)
        half = self.autocast == torch.float16  # whose small gradients would be 0
        self.scaler = torch.GradScaler(accelerator.device.type, enabled=half)
        if job.resume_from is not None:
            load_loss_scale(job.resume_from, self.scaler)

    def parts(self) -> dict[str, Any]:
        """Return what a checkpoint is made of, by lerobot's names."""
        parts = {"policy": self.policy, "optimizer": self.optimizer, "scheduler": self.scheduler}
        return {**parts, "cfg": self.config, "preprocessor": self.before, "postprocessor": self.after}

    def do_step(self, step: int) -> list[SentenceReading]:
        """Do one gradient step, counted from 1; return what was read of sentences that are new."""
        tracker, started, n_known = self.tracker, time.perf_counter(), len(self.readings.known)
        batch = next(self.batches)
        for key in () if getattr(self.job.policy, "takes_bytes", False) else self.images:
            if key in batch:
                batch[key] = in_numbers(batch[key])
        with self.readings.of(batch.get("task") or ()):
            batch = preprocessed(self.before, batch)
            loaded = time.perf_counter()
            seed_step(self.job.run_seed, step - 1, self.accelerator.process_index)
            self.policy.train()
            if torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
            size, scale = self.job.recipe.micro_batch_size, self.scaler.scale
            loss = add_gradient(
                self.policy, batch, self.accelerator, size=size, autocast=self.autocast, scale=scale
            )
        tracker.grad_norm = self._update()
        tracker.loss, tracker.lr = loss.value.item(), self.optimizer.param_groups[0]["lr"]
        tracker.update_metrics(loss.parts)
        tracker.dataloading_s, tracker.update_s = loaded - started, time.perf_counter() - loaded
        if torch.cuda.is_available():
            tracker.gpu_mem_gb = torch.cuda.max_memory_allocated() / (1 << 30)
        tracker.step()
        return list(self.readings.known.values())[n_known:]

    def _update(self) -> float:
        """Change the weights by the gradient that was added up; return its norm."""
        self.scaler.unscale_(self.optimizer)
        limit = self.config.optimizer.grad_clip_norm
        norm = self.accelerator.clip_grad_norm_(self.policy.parameters(), limit if limit > 0 else math.inf)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        self.optimizer.zero_grad()
        if self.scheduler is not None:
            self.scheduler.step()
        model = self.accelerator.unwrap_model(self.policy)
        if has_method(model, "update"):  # of policies with weights that follow slowly
            model.update()
        return float(norm)


def _is_asked_to_stop(accelerator: Accelerator, listeners: Listeners) -> bool:
    """Return whether any of the processes is asked to stop: all write one checkpoint, and have to agree."""
    is_stopping = listeners.is_stopping()
    if accelerator.num_processes == 1:
        return is_stopping
    asked = accelerator.reduce(torch.tensor(int(is_stopping), device=accelerator.device), reduction="sum")
    return bool(asked.item())


def _save(training: _Training, step: int, listeners: Listeners) -> None:
    job, accelerator = training.job, training.accelerator
    folder = write_checkpoint(job, step, accelerator, training.parts(), training.scaler)
    if folder is not None:
        drop_extra_checkpoints(job.out, save_every_steps=job.recipe.save_every_steps)
        listeners.on_checkpoint(folder)
    accelerator.wait_for_everyone()


def seed_step(run_seed: int, step: int, process: int) -> None:
    """Seed all global generators from these three numbers: lerobot's policies draw from them."""
    drawn = np.random.SeedSequence(run_seed, spawn_key=(step, process)).generate_state(1)
    set_seed(int(drawn[0]))


def autocast_dtype(policy: Any, device: str) -> torch.dtype | None:
    """Return the precision of the forward pass: `dtype`, else `use_amp`, else what accelerate was given."""
    if getattr(policy, "dtype", None) in ("bfloat16", "float16", "float32"):
        return None if policy.dtype == "float32" else getattr(torch, policy.dtype)
    if getattr(policy, "use_amp", False) and not hasattr(policy, "dtype"):
        return amp_dtype(device)
    return LAUNCHED.get(os.environ.get(LAUNCHED_PRECISION, ""))


def dataset_of(job: TrainingJob, config: Any) -> Any:
    """Return lerobot's dataset, or one that serves the same from decoded frames."""
    dataset = lerobots_dataset(job, config)
    job.dataset.local.release()
    if job.sample_memory is not None:
        return RememberedFramesDataset(dataset, job.sample_memory)
    if job.recipe.decode_ahead:
        return DecodedFramesDataset(dataset, whole_episodes=job.whole_episodes, reward=job.reward)
    return dataset


def lerobots_dataset(job: TrainingJob, config: Any) -> Any:
    """Return lerobot's dataset of a training."""
    with job.dataset.local.readers():
        return make_dataset(config)


def loader_of(job: TrainingJob, config: Any, dataset: Any, accelerator: Accelerator) -> Any:
    """Return an endless loader of this process's batches, from the job's first step on."""
    episodes = dataset.meta.episodes
    sampler = EpisodeAwareSampler(
        episodes["dataset_from_index"],
        episodes["dataset_to_index"],
        episode_indices_to_use=dataset.episodes,
        drop_n_last_frames=getattr(job.policy, "drop_n_last_frames", 0),
        shuffle=True,
        seed=job.run_seed,
        absolute_to_relative_idx=dataset.absolute_to_relative_idx,
    )
    size, n_processes = job.recipe.batch_size, accelerator.num_processes
    sharing = Sharing(batch_size=size, n_processes=n_processes, process=accelerator.process_index)
    before = sharing
    if job.resume_from is not None:
        n_before = load_training_num_processes(job.resume_from) or n_processes
        size_before = load_training_batch_size(job.resume_from) or size
        before = Sharing(batch_size=size_before, n_processes=n_before)
    is_random = job.recipe.image_transforms is not None
    start = before.position(job.first_step, len(sampler))
    in_workers = {
        "prefetch_factor": config.prefetch_factor,
        "persistent_workers": config.persistent_workers,
        "multiprocessing_context": child_context(),
    }
    return torch.utils.data.DataLoader(
        SeededSamples(dataset, job.run_seed) if is_random else dataset,
        batch_sampler=StepBatches(sampler, start, sharing, numbered=is_random),
        num_workers=config.num_workers,
        pin_memory=accelerator.device.type == "cuda",
        worker_init_fn=_leave_signals_to_the_parent,
        collate_fn=lerobot_collate_fn if dataset.meta.has_language_columns else None,
        **(in_workers if config.num_workers else {}),
    )


def _leave_signals_to_the_parent(_worker: int) -> None:
    """Let a process that loads samples live on at Ctrl-C, which reaches all of them: a step may need it."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def new_tracker(job: TrainingJob, dataset: Any, accelerator: Accelerator) -> Any:
    """Return lerobot's tracker, at the job's first step."""
    measured = dict(REDUCTIONS)
    if not torch.cuda.is_available():
        del measured["gpu_mem_gb"]
    return MetricsTracker(
        job.recipe.batch_size,
        dataset.num_episodes if job.whole_episodes else dataset.num_frames,  # samples of an epoch
        dataset.num_episodes,
        {name: AverageMeter(name, ":.3g", reduction) for name, reduction in measured.items()},
        initial_step=job.first_step,
        accelerator=accelerator,
    )


def next_line(tracker: Any, samples_per_step: int) -> dict[str, float]:
    """Return the means since the last line, and begin new ones; every process has to take part."""
    tracker.reduce_across_ranks()
    tracker.samples_per_s = samples_per_step / (tracker.update_s.avg + tracker.dataloading_s.avg)
    values = tracker.to_dict()
    tracker.reset_averages()
    return {"step": values.pop("steps"), **{name: float(value) for name, value in values.items()}}


def _report(line: Mapping[str, float], out: Path, listeners: Listeners) -> None:
    logging.info(line)
    append_metrics(out, line)
    listeners.on_metrics(line)
    if not math.isfinite(line["loss"]):
        raise TrainingError(
            f"step {line['step']}: the loss is {line['loss']}. Lower the learning rate, or look for fields "
            f"of the dataset that hardly vary (docs/finetuning.md)."
        )


@contextlib.contextmanager
def _logging(file: Path, accelerator: Accelerator) -> Iterator[None]:
    """Let the first process write what is logged to a file, warnings to standard error; then as it was."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        init_logging(
            log_file=file if accelerator.is_main_process else None,
            console_level="WARNING",
            file_level="INFO",
            accelerator=accelerator,
        )
        yield
    finally:
        for handler in root.handlers:
            if handler not in handlers:
                handler.close()
        root.handlers[:] = handlers
        root.setLevel(level)
