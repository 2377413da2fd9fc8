"""What a policy remembers after each inference, and what there was to see: files for linear probes."""

import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

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
from vla_eval.storage.capture_files import EpisodeFile, frames_file, memory_file
from vla_eval.task_state import PrivilegedState

FRAME_PX, LARGER_FRAME_PX = 16, 32
"""Height and width of frames beside a memory, and alone: colours and places survive, texture does not."""
MOST_STEPS = 80  # of which each has a frame alone: longer than any of our tasks waits
MAX_BYTES = 2**30  # of a file when it is unpacked: more than a thousand inferences of any memory of ours
MEMORY, FRAME, STEPS, IN_CUE, SHOWN = "memory/", "frame/", "steps", "in_cue", "shown"


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeMemory:
    """What is in one file: T inferences."""

    steps: NDArray[np.int64]  # (T,) of the inferences
    # name -> (T, …) after each inference; arrays whose shape changes within the episode are not among them
    memory: Mapping[str, NDArray[Any]]
    frames: Mapping[str, NDArray[np.uint8]]  # camera -> (T, px, px, 3) the newest frame at each inference
    in_cue: NDArray[np.bool_] | None = None  # (T,) whether the cue is shown, where frames alone are kept
    # (T, N) which candidates' cues are in view, by the simulator; None where the true state was not kept
    shown: NDArray[np.bool_] | None = None

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
        in_cue = arrays.pop(IN_CUE, None)
        if in_cue is not None and (in_cue.shape != steps.shape or in_cue.dtype != np.bool_):
            raise _refused(path, f"'{IN_CUE}': expected {len(steps)} truth values")
        shown = arrays.pop(SHOWN, None)
        if shown is not None and (shown.ndim != 2 or len(shown) != len(steps) or shown.dtype != np.bool_):
            raise _refused(path, f"'{SHOWN}': expected truth values in {len(steps)} rows")
        for name, array in arrays.items():
            if not name.startswith((MEMORY, FRAME)) or array.shape[:1] != steps.shape:
                raise _refused(path, f"'{name}' {array.shape}: expected an array with {len(steps)} rows")
            if array.dtype.kind not in "biuf":
                raise _refused(path, f"'{name}': expected numbers, found {array.dtype}")
        return cls(
            steps=steps,
            in_cue=in_cue,
            shown=shown,
            memory={n.removeprefix(MEMORY): a for n, a in arrays.items() if n.startswith(MEMORY)},
            frames={n.removeprefix(FRAME): a for n, a in arrays.items() if n.startswith(FRAME)},
        )


@dataclass(slots=True)
class _Log:
    steps: list[int] = field(default_factory=list)
    memories: list[Mapping[str, NDArray[Any]]] = field(default_factory=list)
    frames: list[Mapping[str, ImageArray]] = field(default_factory=list)
    in_cue: list[bool] = field(default_factory=list)
    shown: list[NDArray[np.bool_]] = field(default_factory=list)


class NpzLog(StepObserver):
    """A `StepObserver` that keeps arrays of each episode, and writes a file of each once it has a record."""

    def __init__(self, file: EpisodeFile) -> None:
        """Nothing is written before `write`."""
        self._file = file
        self._logs: dict[int, _Log] = {}

    def write(self, starts: Sequence[EpisodeStart], records: Sequence[EpisodeRecord], run: Path) -> None:
        """Write the file of each episode into a run folder, whole or not at all."""
        (run / self._file.folder).mkdir(exist_ok=True)
        for start, record in zip(starts, records, strict=True):
            _write(self._logs[start.slot], self._file(run, record))


class MemoryLog(NpzLog):
    """Reads the memory of a policy after each inference."""

    def __init__(self, policy: RememberingPolicy) -> None:
        """Nothing is written before `write`."""
        super().__init__(memory_file)
        self._policy = policy
        self._newest: dict[int, Observation] = {}

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
        log.frames.append({camera: small(image, FRAME_PX) for camera, image in images.items()})


class _Wait(NamedTuple):
    """The control steps of an episode of which frames are kept: every so many, and from the response on."""

    every: int = 1
    response_step: int = 0

    def keeps(self, step: int) -> bool:
        return step % self.every == 0 or step >= self.response_step


class FrameLog(NpzLog):
    """Keeps a small frame of each control step until the response, and of its first.

    Of an episode that waits for more than `MOST_STEPS` control steps, it keeps every second, third … frame.
    """

    def __init__(self) -> None:
        """Nothing is written before `write`."""
        super().__init__(frames_file)
        self._waiting: dict[int, _Wait] = {}  # by slot, before the response

    def wants_images(self, step: int) -> bool:
        """Whether a frame of this step is kept of an episode before its response."""
        return step == 0 or any(wait.keeps(step) for wait in self._waiting.values())

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Begin an episode."""
        self._logs[episode.slot] = _Log()
        state = result.observation.privileged
        n_steps = state.response_step if isinstance(state, PrivilegedState) else 0
        self._waiting[episode.slot] = _Wait(max(1, math.ceil(n_steps / MOST_STEPS)), n_steps)
        self._keep(episode.slot, result)

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Keep the frame of this step."""
        if episode.slot in self._waiting:
            self._keep(episode.slot, result)

    def _keep(self, slot: int, result: StepResult) -> None:
        log, seen = self._logs[slot], result.observation
        if not self._waiting[slot].keeps(seen.step):
            return
        # Where an environment does not show its phase to the outside, its true state has it.
        state = seen.privileged if isinstance(seen.privileged, PrivilegedState) else None
        phase = result.status.phase if state is None else state.phase
        log.steps.append(seen.step)
        log.in_cue.append(phase == "cue")
        log.frames.append({camera: small(image, LARGER_FRAME_PX) for camera, image in seen.images.items()})
        if state is not None:
            candidates = np.arange(len(state.candidate_positions_m))
            log.shown.append(np.isin(candidates, state.shown_candidates))
        if phase == "response":
            del self._waiting[slot]


def _write(log: _Log, path: Path) -> None:
    arrays = {
        **{f"{MEMORY}{name}": array for name, array in _stacked(log.memories).items()},
        **{f"{FRAME}{name}": array for name, array in _stacked(log.frames).items()},
        **({IN_CUE: np.array(log.in_cue)} if log.in_cue else {}),
        **({SHOWN: np.array(log.shown)} if log.shown else {}),
    }
    partial = path.with_suffix(".tmp.npz")
    np.savez_compressed(partial, allow_pickle=False, **{STEPS: np.array(log.steps), **arrays})
    os.replace(partial, path)


def _stacked(rows: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the arrays that all rows have, in one shape, with an axis for the rows."""
    return {
        name: np.stack([row[name] for row in rows])
        for name, first in (rows[-1] if rows else {}).items()
        if all(name in row and row[name].shape == first.shape for row in rows)
    }


def small(image: ImageArray, px: int) -> ImageArray:
    """Return means over equal blocks, (px, px, 3)."""
    rows, columns = (np.linspace(0, side, px + 1).astype(int) for side in image.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows[:-1], 0), columns[:-1], 1)
    counts = np.diff(rows)[:, None] * np.diff(columns)[None, :]
    means: ImageArray = np.round(sums / counts[..., None]).astype(np.uint8)
    return means


def _refused(path: Path, problem: str) -> RunFolderError:
    return RunFolderError(f"{path}: {problem}. Remove the file; without it the episode is left out.")
