"""Statistics over all frames of a dataset, exact, in lerobot's form.

lerobot 0.6.1 averages the quantiles of the episodes: of a state that is constant per episode, 0 to 9,
it makes q01 = q99 = 4.5. Policies that normalise by quantiles would be fed nonsense. Here numbers come
from all rows, and those of images from histograms of all raw pixels.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import ImageArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
N_LEVELS = 256  # of a uint8 channel
N_CHANNELS = 3

Histogram = NDArray[np.int64]
"""(3, 256): how many pixels of a channel have a level."""

Statistics = dict[str, NDArray[np.float64]]
"""`min`, `max`, `mean`, `std`, `count`, `q01` … `q99`; arrays, as lerobot has them."""


class _Moments(NamedTuple):
    mean: NDArray[np.float64]
    std: NDArray[np.float64]


def empty_histogram() -> Histogram:
    """Return a histogram of nothing."""
    return np.zeros((N_CHANNELS, N_LEVELS), dtype=np.int64)


def count_levels(image: ImageArray) -> Histogram:
    """Return the histogram of an (H, W, 3) uint8 image."""
    flat = image.reshape(-1, N_CHANNELS)
    return np.stack([np.bincount(flat[:, channel], minlength=N_LEVELS) for channel in range(N_CHANNELS)])


def vector_statistics(rows: NDArray[np.generic]) -> Statistics:
    """Return the statistics of (N, D) numbers, per column, in float64."""
    values = rows.astype(np.float64)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **{name: np.quantile(values, q, axis=0) for name, q in QUANTILES.items()},
    }


def image_statistics(histogram: Histogram, *, n_frames: int) -> Statistics:
    """Return the statistics of a camera, levels scaled to [0, 1]; each value is (3, 1, 1), but `count`.

    A quantile is the level at which that share of the pixels is reached.
    """
    levels = np.arange(N_LEVELS) / (N_LEVELS - 1)
    total = histogram.sum(axis=1)
    moments = _moments(histogram, levels)
    cumulated = histogram.cumsum(axis=1)

    def level_at(share: float) -> NDArray[np.float64]:
        rank = share * (total - 1)  # numpy's definition, by the lower neighbour
        reached: NDArray[np.float64] = levels[(cumulated > rank[:, None]).argmax(axis=1)]
        return reached

    present = histogram > 0
    by_name = {
        "min": levels[present.argmax(axis=1)],
        "max": levels[N_LEVELS - 1 - present[:, ::-1].argmax(axis=1)],
        "mean": moments.mean,
        "std": moments.std,
        **{name: level_at(q) for name, q in QUANTILES.items()},
    }
    shaped = {name: value.reshape(N_CHANNELS, 1, 1) for name, value in by_name.items()}
    return {**shaped, "count": np.array([n_frames])}


def dataset_statistics(
    columns: Mapping[str, NDArray[np.generic]], histograms: Mapping[str, Histogram]
) -> dict[str, Statistics]:
    """Return field -> statistics.

    Args:
        columns: field -> (N,) or (N, D) numbers of all frames.
        histograms: camera field -> histogram of all its frames.
    """
    n_frames = len(next(iter(columns.values())))
    return {
        **{key: vector_statistics(rows.reshape(n_frames, -1)) for key, rows in columns.items()},
        **{key: image_statistics(histogram, n_frames=n_frames) for key, histogram in histograms.items()},
    }


def _moments(histogram: Histogram, levels: NDArray[np.float64]) -> _Moments:
    weights = histogram / histogram.sum(axis=1, keepdims=True)
    mean = weights @ levels
    variance = (weights * (levels[None] - mean[:, None]) ** 2).sum(axis=1)
    return _Moments(mean, np.sqrt(variance))
