"""Check `meta/info.json` before lerobot reads it: its templates can reach any attribute."""

import math
import os
import re
import string
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from vla_eval.errors import DatasetError, some_of
from vla_eval.strict.json_text import Count, Positive, Source, as_dataclass, read_file, read_json, shown

INFO_FILE = Path("meta/info.json")
REMEDY = "It is not read. Fetch the dataset again, from where you trust it."
# The fields that lerobot 0.6.1 fills in (`LeRobotDatasetMetadata.get_data_file_path`, `get_video_file_path`).
TEMPLATES = {
    "data_path": frozenset({"chunk_index", "file_index"}),
    "video_path": frozenset({"chunk_index", "file_index", "video_key"}),
}
FORMAT_LETTERS = frozenset("0123456789d")  # of `{file_index:03d}`
MAX_FORMAT_LETTERS = 3  # a width of up to 99
MAX_AXES = 5  # of what lerobot stores
MAX_NUMBERS = 2**31  # of one field of one frame
VERSION = re.compile(r"v?3\.\d{1,9}(\.\d{1,9})?")
OLD_VERSION = re.compile(r"v?2\.\d{1,9}(\.\d{1,9})?")
NUMBERS = ("bool", *(f"{sign}int{n_bits}" for sign in ("", "u") for n_bits in (8, 16, 32, 64)))
DTYPES = frozenset({*NUMBERS, "float16", "float32", "float64", "string", "image", "video", "language"})
"""What lerobot's features may be. Another word reaches `datasets`, which has types that open files."""
NOT_IN_PATHS = frozenset(":*?[]%\\|")
"""By these fsspec and FFmpeg distinguish addresses and patterns from paths."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetInfo:
    """The fields of lerobot's `info.json` that it computes with; it may hold others."""

    codebase_version: str
    fps: Positive
    features: dict[str, dict[str, Any]]  # Any: JSON
    total_episodes: Count = 0
    total_frames: Count = 0
    total_tasks: Count = 0
    chunks_size: Positive = 1
    data_files_size_in_mb: Positive = 1
    video_files_size_in_mb: Positive = 1
    data_path: str = ""
    video_path: str | None = None
    robot_type: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Feature:
    dtype: str
    shape: tuple[Positive, ...]
    names: Any = field(default=None)  # Any: a list, or a mapping of lists


def read_info(root: Path) -> dict[str, Any]:  # Any: JSON
    """Return `meta/info.json` if it holds what lerobot may be given, else raise `DatasetError`."""
    path = root / INFO_FILE
    source = Source(where=str(path), what="a LeRobotDataset's info", remedy=REMEDY, error=DatasetError)
    try:
        data = read_json(read_file(path, source), source)
    except (FileNotFoundError, NotADirectoryError) as exc:
        raise source.refuse("nothing", "the file is missing") from exc
    info = as_dataclass(DatasetInfo, _known(DatasetInfo, data), source)
    _check_version(info.codebase_version, source)
    for name, feature in info.features.items():
        if not _is_feature_name(name):
            raise source.refuse(
                f"the feature {shown(name)}", "expected a printable name without '/' and '..'"
            )
        within = Source(where=f"{path}: {name}", what="a feature", remedy=REMEDY, error=DatasetError)
        known = as_dataclass(_Feature, _known(_Feature, feature), within)
        dtype = known.dtype
        if not 1 <= len(known.shape) <= MAX_AXES or math.prod(known.shape) > MAX_NUMBERS:
            raise within.refuse(f"shape {shown(known.shape)}", f"expected 1 to {MAX_AXES} axes of a frame")
        if dtype not in DTYPES:
            raise within.refuse(f"dtype {shown(dtype)}", f"expected one of {', '.join(sorted(DTYPES))}")
    for name, allowed in TEMPLATES.items():
        template = getattr(info, name)
        if template is not None and not _is_template(template, allowed):
            places = ", ".join(f"{{{place}}}" for place in sorted(allowed))
            raise source.refuse(
                f"{name} {shown(template)}",
                f"expected a path inside of the dataset with no places but {places}",
            )
    return data


def _check_version(version: str, source: Source) -> None:
    if OLD_VERSION.fullmatch(version):
        raise source.error(
            f"{source.where}: a dataset of version {version}; expected version 3. Convert it with lerobot: "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30 --help"
        )
    if not VERSION.fullmatch(version):
        raise source.refuse(f"codebase_version {shown(version)}", "expected a version 3")


def _known(cls: type, data: dict[str, Any]) -> dict[str, Any]:  # Any: JSON
    return {one.name: data[one.name] for one in fields(cls) if one.name in data}


def _is_feature_name(name: str) -> bool:
    is_part = name.isprintable() and name != "" and "/" not in name and ".." not in name
    return is_part and NOT_IN_PATHS.isdisjoint(name)


def _is_template(template: str, allowed: frozenset[str]) -> bool:
    """Whether `str.format` fills it in with nothing but the allowed values, as a path below the dataset."""
    if Path(template).is_absolute() or ".." in Path(template).parts:
        return False
    try:
        parts = list(string.Formatter().parse(template))
    except ValueError:
        return False
    for text, place, spec, conversion in parts:
        if not NOT_IN_PATHS.isdisjoint(text):
            return False
        if place is None:
            continue
        letters = spec or ""
        is_plain = len(letters) <= MAX_FORMAT_LETTERS and FORMAT_LETTERS.issuperset(letters)
        if place not in allowed or conversion is not None or not is_plain:
            return False
    return True


def require_folder(root: Path) -> None:
    """Raise `DatasetError` if there is no such folder, or nothing in it: before anything heavy is loaded."""
    # os.path, unlike Path, says no to what cannot be a path at all: too long, or with a NUL.
    if not os.path.isdir(root):
        raise DatasetError(f"{root!s:.300}: there is no such folder. `mikasa-vla record` makes datasets.")
    if not os.listdir(root):
        raise DatasetError(
            f"{root}: expected a dataset, found an empty folder. `mikasa-vla record` makes datasets."
        )


def one_dataset(root: Path) -> Path:
    """Return the folder itself, or the one dataset in it: `record --out DIR` makes DIR/TASK."""
    require_folder(root)
    if (root / INFO_FILE).is_file():
        return root
    held = sorted(path for path in root.iterdir() if (path / INFO_FILE).is_file())
    if len(held) > 1:
        raise DatasetError(
            f"{root}: expected one dataset, found {len(held)}: {some_of(path.name for path in held)}. Name "
            f"one, for example {held[0]}, or make one of them (`mikasa-vla dataset mix`)."
        )
    return held[0] if held else root
