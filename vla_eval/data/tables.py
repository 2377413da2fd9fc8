"""Read the tables of a LeRobotDataset: with pyarrow, by local path, columns of plain types alone.

Hugging Face's `datasets` takes a column's type from the parquet file's own metadata, and opens the paths and
addresses that a column of images, sounds or videos holds. So no other reader is given these files; lerobot
gets tables that were read here (`lerobot_tables.py`). Knows nothing of lerobot.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple  # pyarrow is untyped

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from vla_eval.data.folder_contents import check_folder
from vla_eval.errors import DatasetError
from vla_eval.strict.json_text import shown
from vla_eval.workers.start import available_ram_bytes

EPISODE_TABLES = "meta/episodes/*/*.parquet"
FRAME_TABLES = "data/*/*.parquet"
LANGUAGE_COLUMNS = ("language_persistent", "language_events")
"""lerobot's columns of annotations (`lerobot.datasets.language`): lists of texts with fields."""

FOREIGN_METADATA = b"huggingface"
PLAIN_EXTENSIONS = (
    "arrow.json",
    *(f"datasets.features.features.Array{n}DExtensionType" for n in range(2, 6)),
)
"""Extensions of arrow that are read as the plain type they are stored as."""
PLAIN_NUMBERS = (pa.types.is_boolean, pa.types.is_integer, pa.types.is_floating)
PLAIN_TYPES = (pa.types.is_string, pa.types.is_large_string, *PLAIN_NUMBERS)
MIB = 1024**2
REMEDY = "It is not read. Fetch the dataset again, from where you trust it."

Columns = dict[str, NDArray[np.generic]]
"""Field -> (N,) or (N, D), in the order of frames."""


def read_table(
    path: Path, keep: Callable[[str], bool] | None = None, *, with_images: bool = False
) -> Any:  # Any: pyarrow.Table
    """Return a table of a dataset, or the columns that `keep` names, without Hugging Face's notes in it."""
    try:
        with pq.ParquetFile(str(path.absolute())) as file:
            _check_size(path, file.metadata)
            schema = file.schema_arrow
            for column in schema:
                is_plain = _is_plain(column.type, with_fields=column.name in LANGUAGE_COLUMNS)
                if not is_plain and not (with_images and is_image(column.type)):
                    found = f"{shown(column.name)} of the type {shown(str(column.type))}"
                    raise refused(path, "columns of numbers, text, or lists of them", found)
            names = [name for name in schema.names if keep is None or keep(name)]
            if len(set(names)) != len(names):
                raise refused(path, "columns of different names", f"{', '.join(names):.500}")
            table = file.read(columns=names).select(names)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as exc:
        raise DatasetError(f"{path}: cannot be read as parquet ({exc!s:.200}). {REMEDY}") from exc
    noted = {key: value for key, value in (table.schema.metadata or {}).items() if key != FOREIGN_METADATA}
    return table.replace_schema_metadata(noted)


class TableFile(NamedTuple):
    """A file of a table, and what it holds."""

    path: Path
    table: Any  # pyarrow.Table


def read_frame_tables(root: Path) -> list[TableFile]:
    """Return the tables of frames in the order of their rows; errors as `read_table` and `table_paths`."""
    return [TableFile(path, read_table(path, with_images=True)) for path in table_paths(root, FRAME_TABLES)]


def read_columns(root: Path) -> Columns:
    """Return the numbers of a dataset; see `columns_of`."""
    check_folder(root)
    return columns_of(read_frame_tables(root))


def columns_of(files: Sequence[TableFile]) -> Columns:
    """Return the numbers and sentences of frames, without images and annotations."""
    names = [
        column.name
        for column in files[0].table.schema
        if not is_image(column.type) and column.name not in LANGUAGE_COLUMNS
    ]
    for path, table in files:
        check_columns(path, table, names)
        check_values(path, table, names)
    return {name: np.concatenate([as_array(table[name]) for _, table in files]) for name in names}


def as_array(column: Any) -> NDArray[np.generic]:  # Any: pyarrow.ChunkedArray
    """Return a column that `check_values` has seen, in the type in which it is stored."""
    if not holds_numbers(column):
        return np.asarray(column.to_pylist())
    levels = list(_levels(column))
    values = levels[-1]
    inner = [len(after) // len(before) if len(before) else 0 for before, after in pairwise(levels)]
    array: NDArray[np.generic] = values.to_numpy().reshape([len(column), *inner])
    return array


def holds_numbers(column: Any) -> bool:  # Any: pyarrow.ChunkedArray
    """Whether a column holds numbers, or lists of them."""
    *_, values = _levels(column)
    return any(is_kind(values.type) for is_kind in PLAIN_NUMBERS)


def _levels(column: Any) -> Iterator[Any]:  # Any: pyarrow.ChunkedArray
    """Yield a column, and what its lists hold, level by level, as plain types."""
    while True:
        if isinstance(column.type, pa.BaseExtensionType):
            column = pa.chunked_array([chunk.storage for chunk in column.chunks], column.type.storage_type)
        yield column
        if not pa.types.is_nested(column.type) or pa.types.is_struct(column.type):
            return
        column = pc.list_flatten(column)


def rows_of_episode(columns: Columns, episode_index: int) -> Columns:
    """Return the rows of one episode."""
    mask = columns["episode_index"] == episode_index
    return {name: values[mask] for name, values in columns.items()}


def table_paths(root: Path, pattern: str) -> list[Path]:
    """Return the files of a table in the order of their rows; raise `DatasetError` if there are none."""
    paths = sorted(root.glob(pattern))
    if not paths:
        raise DatasetError(f"{root}: there is no {pattern}. Name the folder of one LeRobotDataset (v3).")
    return paths


def check_columns(path: Path, table: Any, names: Sequence[str]) -> None:  # Any: pyarrow.Table
    """Raise `DatasetError` where a table lacks one of these columns."""
    for name in names:
        if name not in table.column_names:
            raise refused(path, f"the column {name}", f"{', '.join(table.column_names):.500}")


def check_values(path: Path, table: Any, names: Sequence[str]) -> None:  # Any: pyarrow.Table
    """Raise `DatasetError` where a row has no value, or a list is of another length than the others."""
    for name in names:
        for level, column in enumerate(_levels(table[name])):
            if column.null_count:
                place = pc.index(pc.is_null(column), True).as_py() * table.num_rows // len(column)
                found = f"none in row {place} ({column.null_count} values are missing)"
                raise refused(path, f"a value in each row of {name}", found)
            if not pa.types.is_nested(column.type) or pa.types.is_struct(column.type):
                break
            lengths = pc.unique(pc.list_value_length(column)).to_pylist()
            if len(lengths) > 1:
                found = f"lengths {', '.join(map(str, sorted(lengths)[:5]))}"
                raise refused(path, f"lists of one length in {name}, level {level}", found)


def refused(path: Path, expected: str, found: str) -> DatasetError:
    """Build the error of a file of a dataset."""
    return DatasetError(f"{path}: expected {expected}, found {found}. {REMEDY}")


def _check_size(path: Path, metadata: Any) -> None:  # Any: pyarrow's
    needed = sum(metadata.row_group(index).total_byte_size for index in range(metadata.num_row_groups))
    free = available_ram_bytes()
    if needed > free:
        raise DatasetError(
            f"{path}: takes {needed / MIB:.0f} MiB of memory, and {free / MIB:.0f} MiB are free. Select "
            "fewer episodes, or use a machine with more."
        )


def _is_plain(kind: Any, *, with_fields: bool = False) -> bool:  # Any: pyarrow.DataType
    if isinstance(kind, pa.BaseExtensionType):
        return kind.extension_name in PLAIN_EXTENSIONS and _is_plain(kind.storage_type)
    if pa.types.is_dictionary(kind):
        return _is_plain(kind.value_type)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return _is_plain(kind.value_type, with_fields=with_fields)
    if pa.types.is_struct(kind):
        return with_fields and all(_is_plain(field.type) for field in kind)
    return any(is_kind(kind) for is_kind in PLAIN_TYPES)


def is_image(kind: Any) -> bool:  # Any: pyarrow.DataType
    """Whether a column may hold images: their bytes, and the name of the file that each once was."""
    if not pa.types.is_struct(kind) or sorted(field.name for field in kind) != ["bytes", "path"]:
        return False
    return bool(pa.types.is_binary(kind.field("bytes").type)) and _is_plain(kind.field("path").type)
