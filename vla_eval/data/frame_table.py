"""Read the numbers of a dataset's frames from its parquet files, without lerobot."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

Columns = dict[str, NDArray[np.generic]]
"""Field -> (N,) or (N, D), in the order of frames."""


def read_columns(root: Path, only: Sequence[str] | None = None) -> Columns:
    """Return numbers of a dataset: field -> (N,) or (N, D), in the order of frames.

    Args:
        root: folder of the dataset.
        only: these fields; None: all.
    """
    columns = None if only is None else list(only)
    tables = [pq.read_table(path, columns=columns) for path in sorted((root / "data").glob("*/*.parquet"))]
    names = tables[0].column_names
    return {name: np.concatenate([np.asarray(table[name].to_pylist()) for table in tables]) for name in names}


def rows_of_episode(columns: Columns, episode_index: int) -> Columns:
    """Return the rows of one episode."""
    mask = columns["episode_index"] == episode_index
    return {name: values[mask] for name, values in columns.items()}
