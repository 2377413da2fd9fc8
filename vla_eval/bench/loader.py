"""Measure the samples that a training gets of our loader and of lerobot's own, on one dataset in one run.

Both loaders serve the batches of a recipe: its windows of frames and chunks, its batch size, as many loader
processes. Each is measured alone, in turn. The first batch of each process is not counted.
"""

import contextlib
import itertools
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
import torch
from accelerate import Accelerator
from lerobot.utils.collate import lerobot_collate_fn
from torch.utils.data import DataLoader

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.config.policy import load_policy
from vla_eval.data.info_file import one_dataset
from vla_eval.data.recording.record import record
from vla_eval.errors import ConformanceError, RecipeError
from vla_eval.features import ACTION_KEY, IMAGE_SHAPE, REWARD_KEY
from vla_eval.training.job import TrainingJob, lerobot_config, training_job
from vla_eval.training.loop import dataset_of, lerobots_dataset, loader_of

TASK = "RememberColor3-v0"
N_EPISODES = 4  # of the dataset that is made if none is named
N_CHECKED = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class LoaderRow:
    """What one recipe's batches cost, in samples per second.

    `first_seconds`: to open our dataset for the first time, decoding included; `again_seconds`: again.
    """

    policy: str
    batch_size: int
    n_frames: int  # of a sample, over all cameras
    n_processes: int
    first_seconds: float
    again_seconds: float
    lerobot_per_second: float
    ours_per_second: float

    @property
    def ratio(self) -> float:
        """How many times as many samples per second our loader serves."""
        return self.ours_per_second / self.lerobot_per_second


@dataclass(frozen=True, slots=True, kw_only=True)
class LoaderReport:
    """The rows of one run; `decoder` is lerobot's video backend.

    `load`: how many processes wanted a core when it began.
    """

    dataset: str
    n_frames: int
    decoder: str
    load: float
    rows: tuple[LoaderRow, ...]


def run_loader_bench(
    root: Path | None, policies: Sequence[str], *, n_batches: int, repeats: int
) -> LoaderReport:
    """Measure both loaders for each recipe; the lowest of `repeats` times counts.

    Without a dataset, demonstrations of the fake simulator are made. Decoded frames go to the user's cache,
    where a training finds them.

    Raises:
        RecipeError: a policy without a section `finetune`.
        ConformanceError: a sample of ours is not lerobot's.
    """
    with contextlib.ExitStack() as stack:
        if root is None:
            root = _recorded(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        jobs = {name: _job(name, one_dataset(root)) for name in policies}
        load = os.getloadavg()[0]
        rows = tuple(_row(name, job, n_batches, repeats) for name, job in jobs.items())
        dataset = next(iter(jobs.values())).dataset
        return LoaderReport(
            dataset=dataset.name,
            n_frames=dataset.meta.total_frames,
            decoder=lerobot_config(next(iter(jobs.values()))).dataset.video_backend,
            load=load,
            rows=rows,
        )


def _recorded(folder: Path) -> Path:
    recipe = DatasetRecipe(name="loader", tasks=(TASK,), episodes=N_EPISODES, simulator="fake")
    record(recipe, out=folder / "demos", command="mikasa-vla bench --loader")
    return folder / "demos" / TASK


def _job(name: str, root: Path) -> TrainingJob:
    """Return a recipe's training on a dataset, from random weights: none are needed to load samples."""
    recipe = load_policy(name).value.finetune
    if recipe is None:
        raise RecipeError(f"bench: policy '{name}' has no section `finetune`: nothing is loaded for it.")
    bare: dict[str, Any] = {"base_checkpoint": None, "rename_cameras": {}, "lora": None}
    config = FinetuneConfig(
        policy=name, dataset=str(root), device="cpu", allow_unreplayed=True, finetune=bare, out="bench"
    )
    return training_job(config)


def _row(name: str, job: TrainingJob, n_batches: int, repeats: int) -> LoaderRow:
    config, accelerator = lerobot_config(job), Accelerator(cpu=True)
    theirs = _theirs(job, config)
    ours, first_seconds = _timed(lambda: dataset_of(job, config))
    _, again_seconds = _timed(lambda: dataset_of(job, config))
    order = [ours.served(index) for index in np.random.default_rng(0).permutation(len(ours)).tolist()]
    for index in order[:N_CHECKED]:
        _check_same(ours[index], theirs[index], f"policy '{name}', sample {index}", job)
    n_first = max(1, config.num_workers)  # of each process the first: while they start, the others get ahead
    slow, fast = [], []
    for _ in range(repeats):
        slow.append(_rate(_lerobots_loader(theirs, config, order, n_first + n_batches), n_first, n_batches))
        fast.append(_rate(loader_of(job, config, ours, accelerator), n_first, n_batches))
    images = [ours[0][key] for key in ours.meta.camera_keys]
    return LoaderRow(
        policy=name,
        batch_size=config.batch_size,
        n_frames=sum(len(image) if image.ndim > len(IMAGE_SHAPE) else 1 for image in images),
        n_processes=config.num_workers,
        first_seconds=first_seconds,
        again_seconds=again_seconds,
        lerobot_per_second=max(slow),
        ours_per_second=max(fast),
    )


def _theirs(job: TrainingJob, config: Any) -> Any:
    """Return lerobot's dataset; of a policy that is trained on whole episodes, with those as its samples."""
    if job.sample_memory is not None:
        raise RecipeError(
            f"bench: policy '{job.name}' is trained on earlier frames of its choice, which lerobot's loader "
            "does not serve. Name others with --policy."
        )
    return lerobots_dataset(job, config)


def _lerobots_loader(dataset: Any, config: Any, order: Sequence[int], n_batches: int) -> Any:
    """Return so many batches, in this order, as lerobot v0.6.1 makes them (scripts/lerobot_train.py)."""
    n_processes = config.num_workers
    in_workers: dict[str, Any] = {
        "prefetch_factor": config.prefetch_factor,
        "persistent_workers": config.persistent_workers,
        "multiprocessing_context": config.dataloader_multiprocessing_context,
    }
    return DataLoader(
        dataset,
        batch_size=config.batch_size,
        sampler=list(itertools.islice(itertools.cycle(order), n_batches * config.batch_size)),
        num_workers=n_processes,
        collate_fn=lerobot_collate_fn if dataset.meta.has_language_columns else None,
        **(in_workers if n_processes else {}),
    )


def _rate(loader: Any, n_first: int, n_batches: int) -> float:
    """Return samples per second of so many batches after the first ones."""
    batches = iter(loader)
    for _ in range(n_first):
        next(batches)
    begun = time.perf_counter()
    n_samples = sum(len(next(batches)[ACTION_KEY]) for _ in range(n_batches))
    return n_samples / (time.perf_counter() - begun)


def _timed[T](work: Callable[[], T]) -> tuple[T, float]:
    begun = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begun


def _check_same(ours: dict[str, Any], theirs: dict[str, Any], where: str, job: TrainingJob) -> None:
    of_ours = (REWARD_KEY,) if job.reward not in (None, "dense") else ()  # other rewards than the table's
    for key, value in theirs.items():
        if key in of_ours:
            continue
        same = torch.equal(ours[key], value) if isinstance(value, torch.Tensor) else ours[key] == value
        if not same:
            raise ConformanceError(
                f"{where}: '{key}' from decoded frames is not lerobot's, expected equal bits. Please "
                f"report this with the output of `mikasa-vla doctor`."
            )
