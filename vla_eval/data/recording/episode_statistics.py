"""The statistics of each episode that LeRobot stores, from all rows, and pixels counted by level.

LeRobot 0.6.1 sorts numbers and pixels into 5,000 bins between the least and the greatest so far: a tenth of
the CPU time of a recording. A channel has 256 levels, so counting them is exact as well as cheap.
"""

from typing import Any  # lerobot is untyped

import numpy as np
from lerobot.datasets import compute_stats
from numpy.typing import NDArray

from vla_eval.data.exact_statistics import (
    N_CHANNELS,
    N_LEVELS,
    count_levels,
    empty_histogram,
    image_statistics,
    vector_statistics,
)

_Bins = compute_stats.RunningQuantileStats
LEAST_ROWS = 2


class ExactStatistics(_Bins):  # type: ignore[misc, valid-type]  # lerobot is untyped
    """LeRobot's running statistics of an episode, exact: (N, 3) uint8 rows are pixels, others are kept."""

    def __init__(self) -> None:
        super().__init__()
        self._levels = empty_histogram()
        self._rows: list[NDArray[Any]] = []

    def update(self, batch: NDArray[Any]) -> None:
        """Take rows, (N, D), all of one type."""
        if batch.dtype == np.uint8 and batch.shape[-1] == N_CHANNELS:
            self._levels += count_levels(batch)
        else:
            self._rows.append(batch)

    def get_statistics(self) -> dict[str, NDArray[Any]]:
        """Return LeRobot's statistics of all rows, (D,) each, in their units."""
        n_pixels = int(self._levels[0].sum())
        n_rows = n_pixels or sum(map(len, self._rows))
        if n_rows < LEAST_ROWS:
            raise ValueError(f"Statistics need at least {LEAST_ROWS} rows, found {n_rows}.")
        if not n_pixels:
            return vector_statistics(np.concatenate(self._rows))
        scaled = image_statistics(self._levels, n_frames=n_pixels)
        count = scaled.pop("count")
        return {
            "count": count,
            **{name: values.reshape(N_CHANNELS) * (N_LEVELS - 1) for name, values in scaled.items()},
        }


def use_exact_statistics() -> None:
    """Let LeRobot, which takes the class for each episode, use `ExactStatistics` in this process."""
    compute_stats.RunningQuantileStats = ExactStatistics
