"""A linear probe: the class of an episode from some of its numbers. Pure functions of arrays."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

N_FOLDS = 5
RIDGE = 0.1  # of the mean squared length of an episode's features, which is 1
Vectors = NDArray[np.float64]


def folds_of(seeds: Sequence[int]) -> NDArray[np.int64]:
    """Return the fold of each episode: the same for the same seed."""
    return np.array(seeds, np.int64) % N_FOLDS


def predicted(
    parts: Sequence[Vectors], labels: NDArray[np.int64], folds: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return what ridge regression on the other folds predicts for each row: the class of the largest number.

    Args:
        parts: arrays (N, D), such as an image or one array of a memory. Each is centred, and scaled as a
            whole, so that each counts as much as the others, and within it what varies most counts most.
            (Pixels that hardly vary would drown the others if each number were scaled by itself.) Numbers
            that are not finite count as the mean.
        labels: (N,) classes.
        folds: (N,) the fold of each row.
    """
    return predicted_from(np.mean([kernels(part, folds) for part in parts], axis=0), labels, folds)


def kernels(part: Vectors, folds: NDArray[np.int64]) -> Vectors:
    """Return (F, N, N): the inner products of all rows of a part, as they are when each fold is left out."""
    train = [folds != fold for fold in np.unique(folds)]
    return np.array([_kernel(part, one) if one.any() else np.zeros((len(part),) * 2) for one in train])


def predicted_from(kernel: Vectors, labels: NDArray[np.int64], folds: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return what `predicted` does, from the mean (F, N, N) of the kernels of all parts."""
    found = np.full(len(labels), labels[0])
    for of_fold, fold in zip(kernel, np.unique(folds), strict=True):
        test, train = folds == fold, folds != fold
        if not train.any():
            continue
        classes = np.unique(labels[train])
        targets = (labels[train][:, None] == classes[None, :]).astype(np.float64)
        bias = targets.mean(axis=0)
        within = of_fold[np.ix_(train, train)]
        weights = np.linalg.solve(within + RIDGE * np.eye(len(within)), targets - bias)
        scores = bias + of_fold[np.ix_(test, train)] @ weights
        found[test] = classes[scores.argmax(axis=1)]
    return found


def _kernel(part: Vectors, train: NDArray[np.bool_]) -> Vectors:
    """Return the inner products of all rows, centred and scaled by those that are fitted on."""
    finite = np.isfinite(part)
    n = np.maximum(finite[train].sum(axis=0), 1)
    mean = np.where(finite[train], part[train], 0.0).sum(axis=0) / n
    centred = np.where(finite, np.where(finite, part, 0.0) - mean, 0.0)
    length = float(np.sqrt((centred[train] ** 2).sum(axis=1).mean()))
    # What is constant up to rounding says nothing, however small the unit.
    size = float(np.abs(mean).max(initial=0.0)) * np.sqrt(part.shape[1])
    if length <= 1e-6 * size or length == 0.0:
        return np.zeros((len(part), len(part)))
    scaled = centred / length
    kernel: Vectors = scaled @ scaled.T
    return kernel
