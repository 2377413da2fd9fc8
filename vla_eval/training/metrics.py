"""Metrics of a training: means over the steps since the last line, and the file that keeps the lines."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # lerobot and accelerate are untyped

import torch
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker

from vla_eval.training.job import TrainingJob

REDUCTIONS = {
    **{"loss": "mean", "grad_norm": "none", "lr": "none", "update_s": "max", "dataloading_s": "max"},
    **{"samples_per_s": "none", "gpu_mem_gb": "max"},
}
"""What is measured -> how the numbers of several processes become one; those of a policy's own are means."""


def new_tracker(job: TrainingJob, dataset: Any, accelerator: Any) -> Any:
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


def append_metrics(file: Path, line: Mapping[str, float | str]) -> None:
    """Write one line of metrics."""
    with file.open("a", encoding="utf-8") as lines:
        lines.write(f"{json.dumps(dict(line))}\n")
