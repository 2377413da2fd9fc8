"""What a policy remembers after each inference, and what it saw: a file per episode, for linear probes."""

import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    ImageArray,
    Observation,
    RememberingPolicy,
    StepObserver,
    StepResult,
)
from vla_eval.errors import RunFolderError
from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import memory_file
from vla_eval.storage.folders import MEMORIES

FRAME_PX = 16
"""Height and width of the frames: colours and places survive, texture does not."""
MAX_BYTES = 2**30  # of a file when it is unpacked: more than a thousand inferences of any memory of ours
MEMORY, FRAME, STEPS = "memory/", "frame/", "steps"


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeMemory:
    """What is in one file: T inferences."""

    steps: NDArray[np.int64]  # (T,) of the inferences
    # name -> (T, …) after each inference; arrays whose shape changes within the episode are not among them
    memory: Mapping[str, NDArray[Any]]
    frames: Mapping[str, NDArray[np.uint8]]  # camera -> (T, 16, 16, 3) the newest frame at each inference

    @classmethod
    def read(cls, path: Path) -> "EpisodeMemory":
        """Read a file, without pickles; a `RunFolderError` if it is not one of these."""
        try:
            with zipfile.ZipFile(path) as archive:
                n_bytes = sum(member.file_size for member in archive.infolist())
            if n_bytes > MAX_BYTES:
                raise _refused(path, f"expected at most {MAX_BYTES} bytes when unpacked, found {n_bytes}")
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except (OSError, EOFError, ValueError, zipfile.BadZipFile) as exc:
            raise _refused(path, f"expected arrays in npz, found {type(exc).__name__}: {exc}") from exc
        steps = arrays.pop(STEPS, None)
        if steps is None or steps.ndim != 1 or steps.dtype.kind != "i":
            raise _refused(path, f"expected '{STEPS}' with whole numbers (T,)")
        for name, array in arrays.items():
            if not name.startswith((MEMORY, FRAME)) or array.shape[:1] != steps.shape:
                raise _refused(path, f"'{name}' {array.shape}: expected an array with {len(steps)} rows")
            if array.dtype.kind not in "biuf":
                raise _refused(path, f"'{name}': expected numbers, found {array.dtype}")
        return cls(
            steps=steps,
            memory={n.removeprefix(MEMORY): a for n, a in arrays.items() if n.startswith(MEMORY)},
            frames={n.removeprefix(FRAME): a for n, a in arrays.items() if n.startswith(FRAME)},
        )


@dataclass(slots=True)
class _Log:
    steps: list[int] = field(default_factory=list)
    memories: list[Mapping[str, NDArray[Any]]] = field(default_factory=list)
    frames: list[Mapping[str, ImageArray]] = field(default_factory=list)


class MemoryLog(StepObserver):
    """A `StepObserver` that reads the memory of a policy after each inference."""

    def __init__(self, policy: RememberingPolicy) -> None:
        """Nothing is written before `write`."""
        self._policy = policy
        self._newest: dict[int, Observation] = {}
        self._logs: dict[int, _Log] = {}

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Begin an episode."""
        self._logs[episode.slot] = _Log()
        self._newest[episode.slot] = result.observation

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Keep the newest observation."""
        self._newest[episode.slot] = result.observation

    def on_inference(self, episode: EpisodeStart, step: int, chunk: ActionChunk) -> None:
        """Read the memory."""
        log = self._logs[episode.slot]
        log.steps.append(step)
        log.memories.append(self._policy.get_memory(episode.slot))
        images = self._newest[episode.slot].images
        log.frames.append({camera: _small(image) for camera, image in images.items()})

    def write(self, starts: Sequence[EpisodeStart], records: Sequence[EpisodeRecord], folder: Path) -> None:
        """Write the file of each episode, whole or not at all."""
        (folder / MEMORIES).mkdir(exist_ok=True)
        for start, record in zip(starts, records, strict=True):
            log, path = self._logs[start.slot], memory_file(folder, record)
            arrays = {
                **{f"{MEMORY}{name}": array for name, array in _stacked(log.memories).items()},
                **{f"{FRAME}{name}": array for name, array in _stacked(log.frames).items()},
            }
            partial = path.with_suffix(".tmp.npz")
            np.savez_compressed(partial, allow_pickle=False, **{STEPS: np.array(log.steps), **arrays})
            os.replace(partial, path)


def _stacked(rows: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the arrays that all rows have, in one shape, with an axis for the rows."""
    return {
        name: np.stack([row[name] for row in rows])
        for name, first in rows[-1].items()
        if all(name in row and row[name].shape == first.shape for row in rows)
    }


def _small(image: ImageArray) -> ImageArray:
    """Return means over equal blocks, (16, 16, 3)."""
    rows, columns = (np.linspace(0, side, FRAME_PX + 1).astype(int) for side in image.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows[:-1], 0), columns[:-1], 1)
    counts = np.diff(rows)[:, None] * np.diff(columns)[None, :]
    means: ImageArray = np.round(sums / counts[..., None]).astype(np.uint8)
    return means


def _refused(path: Path, problem: str) -> RunFolderError:
    return RunFolderError(f"{path}: {problem}. Remove the file; without it the episode is left out.")
