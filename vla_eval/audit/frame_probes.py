"""Linear probes on small frames: the best of a few readings, each episode predicted from other seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vla_eval.audit.readings import READINGS, Features
from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.results.linear_probe import Vectors, folds_of, kernels, predicted_from

Right = NDArray[np.bool_]  # (N,) in which episodes


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameProbes:
    """Linear probes on the frames of one task, aligned at the first frame of the response, the newest.

    A probe is right if it is right in everything that is asked. Each episode is predicted by probes that are
    fitted on the episodes of other seeds.
    """

    n_steps: int
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
        frames = [np.array([memory.frames[name][-n_steps:] for memory in memories]) for name in cameras]
        in_cue = [memory.in_cue[-n_steps:] for memory in memories if memory.in_cue is not None]
        return cls(
            n_steps=n_steps,
            cue=tuple(np.flatnonzero(np.any(in_cue, axis=0)[:-1]).tolist()) if in_cue else (),
            features=tuple(tuple(map(read, frames)) for read in READINGS.values()),
            answers=np.array(labels),
            folds=folds_of(seeds),
        )

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
