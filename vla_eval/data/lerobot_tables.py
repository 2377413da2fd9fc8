"""Functions that replace `lerobot.datasets.io_utils`: the same answers, read by `tables.py`."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any  # pyarrow and datasets are untyped

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from datasets import Dataset, DatasetInfo, Features, Image  # type: ignore[attr-defined]  # a folder of recipes
from datasets.table import table_cast
from numpy.typing import NDArray

from vla_eval.data.info_file import read_info
from vla_eval.data.tables import (
    EPISODE_TABLES,
    LANGUAGE_COLUMNS,
    REMEDY,
    Columns,
    TableFile,
    check_columns,
    check_values,
    columns_of,
    is_image,
    read_frame_tables,
    read_table,
    refused,
    table_paths,
)
from vla_eval.errors import DatasetError
from vla_eval.strict.json_text import Source, read_file, read_json, shown

TASKS_FILE = Path("meta/tasks.parquet")
STATS_FILE = Path("meta/stats.json")
STATISTICS = "stats/"
"""Beginning of the columns with the statistics of each episode, which lerobot drops."""
EPISODE_COLUMNS = (
    *("episode_index", "dataset_from_index", "dataset_to_index"),
    *("data/chunk_index", "data/file_index"),
)
SENTENCE_COLUMNS = ("task", "__index_level_0__")  # what pandas calls an index with and without a name
IMAGE_BEGINNINGS = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*")  # PNG, JPEG, TIFF of depth


def frames_for_lerobot(
    files: Sequence[TableFile], features: Features, episodes: Sequence[int] | None = None
) -> Dataset:
    """Return the rows of frames, of all episodes or of these, as lerobot's `load_nested_dataset` does."""
    return _as_dataset(pa.concat_tables([_frames(file, features, episodes) for file in files]), features)


def read_episodes(root: Path) -> Dataset:
    """Return one row per episode, as lerobot's `load_episodes` does."""
    tables = []
    for path in table_paths(root, EPISODE_TABLES):
        table = read_table(path, lambda name: not name.startswith(STATISTICS))
        check_columns(path, table, EPISODE_COLUMNS)
        tables.append(table.replace_schema_metadata(None))
    try:
        joined = pa.concat_tables(tables, promote_options="default")
    except pa.ArrowException as exc:
        raise DatasetError(f"{root / 'meta/episodes'}: its tables differ ({exc!s:.200}). {REMEDY}") from exc
    _check_episodes(root / "meta/episodes", joined)
    return _as_dataset(joined, Features.from_arrow_schema(joined.schema))


def read_tasks(root: Path) -> pd.DataFrame:
    """Return the sentences in the order of `task_index`; lerobot's `load_tasks` keeps that of the file."""
    path = root / TASKS_FILE
    table = read_table(path)
    column = next((name for name in SENTENCE_COLUMNS if name in table.column_names), SENTENCE_COLUMNS[0])
    check_columns(path, table, ("task_index", column))
    numbers, sentences = table["task_index"].to_pylist(), table[column].to_pylist()
    no_text = [sentence for sentence in sentences if not isinstance(sentence, str)]
    if no_text:
        raise refused(path, "a sentence in each row", shown(no_text[0]))
    if not pa.types.is_integer(table["task_index"].type) or set(numbers) != set(range(len(numbers))):
        raise refused(path, f"each task_index from 0 to {len(numbers) - 1} once", shown(numbers))
    by_number = dict(zip(numbers, sentences, strict=True))
    in_order = pd.Index([by_number[number] for number in range(len(numbers))], name="task")
    return pd.DataFrame({"task_index": range(len(numbers))}, index=in_order)


def read_statistics(root: Path) -> dict[str, dict[str, NDArray[np.generic]]] | None:
    """Return field -> name -> numbers, as lerobot's `load_stats` does; None if there is no such file."""
    path = root / STATS_FILE
    if not path.exists():
        return None
    source = Source(where=str(path), what="statistics by field and name", remedy=REMEDY, error=DatasetError)
    # lerobot writes NaN where a column has it; which frame that is, the rules say (`checks.rules`).
    fields = read_json(read_file(path, source), source, non_finite=True)
    for field, values in fields.items():
        if not isinstance(values, dict):
            raise source.refuse(f"{shown(field)}: {shown(values)}", "expected a mapping")
    return {
        field: {name: _numbers(value, f"{field}: {name}", source) for name, value in values.items()}
        for field, values in fields.items()
    }


def _once[T](read: Callable[[Path], T]) -> "functools.cached_property[T]":
    return functools.cached_property(lambda tables: read(tables._root))


class Tables:
    """What the files of a dataset hold, each read once: when it is first asked for."""

    def __init__(self, root: Path) -> None:
        self._root = root

    info = _once(read_info)
    episodes = _once(read_episodes)
    tasks = _once(read_tasks)
    statistics = _once(read_statistics)
    frames = _once(read_frame_tables)

    @functools.cached_property
    def columns(self) -> Columns:
        """See `columns_of`."""
        return columns_of(self.frames)


def _frames(file: TableFile, features: Features, episodes: Sequence[int] | None) -> Any:  # Any: pyarrow.Table
    path, table = file
    check_columns(path, table, list(features))
    undeclared = [name for name in table.column_names if name not in features]
    if undeclared:
        raise refused(path, "only columns that meta/info.json declares", shown(undeclared[0]))
    check_values(path, table, [name for name in features if name not in LANGUAGE_COLUMNS])
    if episodes is not None:
        table = table.filter(pc.is_in(table["episode_index"], pa.array(list(episodes), pa.int64())))
    for name, feature in features.items():
        if isinstance(feature, Image):
            table = _embedded_images(path, table, name)
    try:
        return table_cast(table.select(list(features)), features.arrow_schema)
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as exc:
        raise DatasetError(
            f"{path}: its values are not of the types in meta/info.json ({exc!s:.200}). {REMEDY}"
        ) from exc


def _embedded_images(path: Path, table: Any, name: str) -> Any:  # Any: pyarrow.Table
    """Return the table with the bytes of its images alone: a path in their place would be opened."""
    if not is_image(table[name].type):
        raise refused(path, f"images in the column {name}", f"the type {shown(str(table[name].type))}")
    content = pc.struct_field(table[name], "bytes").combine_chunks()
    for row, value in enumerate(content):
        if not value.is_valid or not value.as_py()[:8].startswith(IMAGE_BEGINNINGS):
            raise refused(path, f"the bytes of a PNG, JPEG or TIFF in each {name}", f"others in row {row}")
    images = pa.StructArray.from_arrays([content, pa.nulls(len(content), pa.string())], ["bytes", "path"])
    return table.set_column(table.column_names.index(name), name, images)


def _check_episodes(where: Path, table: Any) -> None:  # Any: pyarrow.Table
    for name in EPISODE_COLUMNS:
        if not pa.types.is_integer(table[name].type) or table[name].null_count:
            raise refused(where, f"a whole number in each row of {name}", shown(table[name].to_pylist()))
    numbers, firsts, stops = (table[name].to_pylist() for name in EPISODE_COLUMNS[:3])
    if numbers != list(range(len(numbers))):
        raise refused(where, f"the episodes 0 to {len(numbers) - 1} in a row", shown(numbers))
    begin = 0
    for number, first, stop in zip(numbers, firsts, stops, strict=True):
        if first != begin or stop <= first:
            raise refused(where, f"frames of episode {number} from {begin} on", f"{first} to {stop}")
        begin = stop


def _numbers(value: object, what: str, source: Source) -> NDArray[np.generic]:
    try:
        numbers = np.atleast_1d(np.array(value))
    except ValueError as exc:  # lists of unlike lengths
        raise source.refuse(f"{shown(what)} {shown(value)}", "expected lists of one length") from exc
    if numbers.dtype.kind not in "iufb":
        raise source.refuse(f"{shown(what)} {shown(value)}", "expected numbers")
    return numbers


def _as_dataset(table: Any, features: Features) -> Dataset:  # Any: pyarrow.Table
    # Without a fingerprint `datasets` hashes the whole table for one. Nothing is cached under it.
    return Dataset(table, info=DatasetInfo(features=features), fingerprint=f"{id(table):032x}")
