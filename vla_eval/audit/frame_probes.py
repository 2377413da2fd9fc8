"""Linear probes on small frames: the best of a few readings, each episode predicted from other seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.audit.readings import READINGS, Features, background
from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.results.linear_probe import Vectors, folds_of, kernels, predicted_from

Right = NDArray[np.bool_]  # (N,) in which episodes


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameProbes:
    """Linear probes on the frames of one task, aligned at the first frame of the response, the newest.

    Where the response does not begin at the same step in all episodes, the first frame of each and the last
    of its cue are not aligned: they have numbers of their own, after the newest.

    A probe is right if it is right in everything that is asked. Each episode is predicted by probes that are
    fitted on the episodes of other seeds.
    """

    newest: int  # number of the frame
    is_aligned: bool  # whether the cue is shown at the same steps in all episodes
    cue: tuple[int, ...]  # steps at which the cue is shown, in any episode
    features: tuple[tuple[Features, ...], ...]  # of each reading: of each camera (N, T, D)
    answers: NDArray[np.int64]  # (N, L)
    folds: NDArray[np.int64]  # (N,)
    # (reading, step) -> its kernels, computed once
    kernels: dict[tuple[int, int], Vectors] = field(default_factory=dict)

    @classmethod
    def of(
        cls, memories: Sequence[EpisodeMemory], labels: Sequence[tuple[int, ...]], seeds: Sequence[int]
    ) -> "FrameProbes":
        """Return the probes of these episodes."""
        n_steps = min(len(memory.steps) for memory in memories)
        cameras = sorted(memories[0].frames)
        frames = [np.array([_aligned(one, name, n_steps) for one in memories]) for name in cameras]
        in_cue = [memory.in_cue[-n_steps:] for memory in memories if memory.in_cue is not None]
        return cls(
            newest=n_steps - 1,
            is_aligned=len({bytes(_cue_of(one)) for one in memories}) == 1,
            cue=tuple(np.flatnonzero(np.any(in_cue, axis=0)[:-1]).tolist()) if in_cue else (),
            features=tuple(
                tuple(read(one, background(one[:, :n_steps])) for one in frames) for read in READINGS.values()
            ),
            answers=np.array(labels),
            folds=folds_of(seeds),
        )

    @property
    def first(self) -> int:
        """Number of the first frame of each episode."""
        return self.newest + 1

    @property
    def cue_end(self) -> int:
        """Number of the last frame of each episode's cue; without a cue, of the last before the newest."""
        return self.newest + 2

    @property
    def own(self) -> tuple[int, ...]:
        """The numbers of the two, where they are not among those before the newest."""
        return () if self.is_aligned else (self.first, self.cue_end)

    def best_of(self, choices: Sequence[tuple[int, ...]]) -> tuple[Right, int]:
        """Return in which episodes the best of some choices of steps is right, and the last step of it.

        What is best, and which reading of the frames, is chosen on the other folds.
        """
        options = [(reading, steps) for steps in choices for reading in range(len(READINGS))]
        right = [self._right(self._mean(reading, steps)) for reading, steps in options]
        found, chosen = best_option(np.array(right), self.folds)
        return found, options[chosen][1][-1]

    def everything(self, steps: Sequence[int]) -> Right:
        """Return in which episodes probes on all of these frames are right: each by itself, or their mean."""
        right = []
        for reading in range(len(READINGS)):
            pooled = [one[:, list(steps)].mean(axis=1) for one in self.features[reading]]
            right += [
                self._right(self._mean(reading, steps)),
                self._right(np.mean([kernels(one.astype(np.float64), self.folds) for one in pooled], axis=0)),
            ]
        return best_option(np.array(right), self.folds)[0]

    def _mean(self, reading: int, steps: Sequence[int]) -> Vectors:
        mean: Vectors = np.mean([self._kernel(reading, step) for step in steps], axis=0)
        return mean

    def _kernel(self, reading: int, step: int) -> Vectors:
        """Return the kernels (F, N, N) of one frame, all cameras."""
        key = (reading, step)
        if key not in self.kernels:
            each = [kernels(one[:, step].astype(np.float64), self.folds) for one in self.features[reading]]
            self.kernels[key] = np.mean(each, axis=0)
        return self.kernels[key]

    def _right(self, kernel: Vectors) -> Right:
        """Return in which episodes the probes are right in everything that is asked."""
        told = [predicted_from(kernel, column, self.folds) == column for column in self.answers.T]
        right: Right = np.all(told, axis=0)
        return right


def _aligned(memory: EpisodeMemory, camera: str, n_steps: int) -> NDArray[Any]:
    """Return (n_steps + 2, px, px, 3): the last frames, then the first and the last of the cue."""
    frames = memory.frames[camera]
    cue = np.flatnonzero(_cue_of(memory)[:-1])
    cue_end = int(cue[-1]) if len(cue) else max(len(frames) - 2, 0)
    return np.concatenate([frames[-n_steps:], frames[[0, cue_end]]])


def _cue_of(memory: EpisodeMemory) -> NDArray[np.bool_]:
    """Return (T,) whether the cue is shown; False where it is not known."""
    return np.zeros(len(memory.steps), dtype=bool) if memory.in_cue is None else memory.in_cue


def best_option(by_option: NDArray[np.bool_], folds: NDArray[np.int64]) -> tuple[Right, int]:
    """Return where the best option (first axis) is right, and which it is: the one that most folds choose.

    For the episodes of a fold, it is the one that is right most often in the other folds.
    """
    found = np.zeros(by_option.shape[1], dtype=bool)
    chosen = []
    for fold in np.unique(folds):
        option = int(by_option[:, folds != fold].sum(axis=1).argmax())
        found[folds == fold] = by_option[option, folds == fold]
        chosen.append(option)
    return found, max(sorted(set(chosen)), key=chosen.count)
