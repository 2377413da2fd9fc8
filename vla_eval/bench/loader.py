"""Measure how much faster samples come from decoded frames than from video, in one process."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
import torch

from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import ConformanceError
from vla_eval.features import ACTION_KEY
from vla_eval.testing.synthetic import write_synthetic_dataset

CHUNK_SIZE = 8
N_CHECKED = 16
SYNTHETIC_EPISODES, SYNTHETIC_FRAMES = 25, 20  # as long as RememberColor3's, a tenth as many


@dataclass(frozen=True, slots=True, kw_only=True)
class LoaderReport:
    """What one run measured: decoded frames against lerobot's video backend `decoder`, in samples per second.

    `first_seconds`: to open the decoded frames for the first time, decoding included; `again_seconds`: again.
    """

    dataset: str
    n_frames: int
    n_cameras: int
    decoder: str
    n_samples: int
    first_seconds: float
    again_seconds: float
    lerobot_per_second: float
    decoded_per_second: float

    @property
    def ratio(self) -> float:
        """How many times faster samples come from decoded frames."""
        return self.decoded_per_second / self.lerobot_per_second


def run_loader_bench(root: Path | None, *, n_samples: int, repeats: int) -> LoaderReport:
    """Measure random access with chunks of eight actions; the lowest of `repeats` times counts.

    Decoded frames go to a folder that is deleted again; without a dataset a synthetic one is measured.
    """
    with tempfile.TemporaryDirectory() as scratch:
        if root is None:
            root = write_synthetic_dataset(
                Path(scratch) / "synthetic", n_episodes=SYNTHETIC_EPISODES, n_frames=SYNTHETIC_FRAMES
            )
        return _measure(root, Path(scratch), n_samples=n_samples, repeats=repeats)


def _measure(root: Path, scratch: Path, *, n_samples: int, repeats: int) -> LoaderReport:
    fps = open_local_dataset(root).fps
    theirs = open_local_dataset(root, delta_timestamps={ACTION_KEY: [i / fps for i in range(CHUNK_SIZE)]})
    ours, first_seconds = _timed(lambda: DecodedFramesDataset(theirs, cache=scratch))
    _, again_seconds = _timed(lambda: DecodedFramesDataset(theirs, cache=scratch))
    order = np.random.default_rng(0).integers(len(theirs), size=n_samples).tolist()
    for index in order[:N_CHECKED]:
        _check_same(ours[index], theirs[index], index)
    slow, fast = [], []
    for _ in range(repeats):
        slow.append(_timed(lambda: [theirs[i] for i in order])[1])
        fast.append(_timed(lambda: [ours[i] for i in order])[1])
    return LoaderReport(
        dataset=root.name,
        n_frames=len(theirs),
        n_cameras=len(theirs.meta.video_keys),
        decoder=theirs._video_backend,
        n_samples=n_samples,
        first_seconds=first_seconds,
        again_seconds=again_seconds,
        lerobot_per_second=n_samples / min(slow),
        decoded_per_second=n_samples / min(fast),
    )


def _timed[T](work: Callable[[], T]) -> tuple[T, float]:
    begun = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begun


def _check_same(ours: dict[str, Any], theirs: dict[str, Any], index: int) -> None:
    for key, value in theirs.items():
        same = torch.equal(ours[key], value) if isinstance(value, torch.Tensor) else ours[key] == value
        if not same:
            raise ConformanceError(
                f"sample {index}: '{key}' from decoded frames is not lerobot's, expected equal bits. Please "
                f"report this with the output of `mikasa-vla doctor`."
            )
