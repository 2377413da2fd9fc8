"""Read a checkpoint of the original code without jax: parameters and statistics. Pickles are never read.

Two layouts of parameters are read: a safetensors file whose names are the parameter tree's joined with
".", and flax's msgpack (`checkpoint`, as orbax aggregates it). The layouts of one folder per parameter
(zarr, OCDBT) need tensorstore and are not read; the message says how to export them.

Source of the formats: https://github.com/msgpack/msgpack/blob/master/spec.md and
https://github.com/google/flax/blob/v0.10.4/flax/serialization.py (extension 1: an array as shape, name of
its type, bytes).
"""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple  # Any: plain data of JSON and msgpack

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from vla_eval.errors import CheckpointError, did_you_mean
from vla_eval.strict.json_fields import read_json

STATISTICS_FILE = "dataset_statistics.json"
AGGREGATED_FILE = "checkpoint"
ARRAY_EXTENSION = 1
CHUNKED = "__msgpack_chunked_array__"
EXPORT_HINT = (
    "Where jax is installed, export it once: flatten OctoModel.load_pretrained(PATH).params with "
    "flax.traverse_util.flatten_dict(params, sep='.') and write it with safetensors.numpy.save_file."
)


def read_parameters(folder: Path) -> dict[str, Tensor]:
    """Return the original's parameter tree, flat, from its folder, a step in it, or one file.

    Raises:
        CheckpointError: there is none, several, or one in a layout that is not read.
    """
    files = [folder] if folder.is_file() else _parameter_files(folder)
    if len(files) != 1:
        found = ", ".join(str(file) for file in files) or "none"
        raise CheckpointError(
            f"{folder}: expected one file of parameters (*.safetensors or {AGGREGATED_FILE}), found {found}. "
            f"Name one of several. {EXPORT_HINT}"
        )
    (file,) = files
    if file.suffix == ".safetensors":
        try:
            return dict(load_file(file))
        except Exception as exc:  # safetensors raises its own class, which is no public name
            raise CheckpointError(f"{file}: cannot be read as safetensors ({exc}). Fetch it again.") from exc
    tree = unpack(file.read_bytes(), where=str(file))
    if not isinstance(tree, dict):
        raise CheckpointError(f"{file}: expected a tree of parameters, found {type(tree).__name__}.")
    inner = tree.get("params", tree)
    return {key: torch.from_numpy(np.array(values)) for key, values in _flat(inner).items()}


def read_statistics(folder: Path, *, dataset: str | None) -> dict[str, list[float]]:
    """Return the statistics of actions of a dataset: name -> one number per dimension.

    Raises:
        CheckpointError: there are none, or several and none is named.
    """
    data = read_json(folder / STATISTICS_FILE)
    if "action" not in data:
        if dataset is None or dataset not in data:
            hint = did_you_mean(dataset, data) if dataset else ""
            raise CheckpointError(
                f"{folder / STATISTICS_FILE}: holds the statistics of several datasets; name one with "
                f"--dataset-name.{hint} There are: {', '.join(sorted(data))}."
            )
        data = data[dataset]
    action = data["action"]
    return {name: [float(x) for x in values] for name, values in action.items() if isinstance(values, list)}


def _parameter_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise CheckpointError(f"{folder}: no such folder.")
    layouts = [*folder.rglob(".zarray"), *folder.rglob("manifest.ocdbt")]
    if layouts:
        raise CheckpointError(
            f"{folder}: holds a folder per parameter (zarr or OCDBT), which is not read. {EXPORT_HINT}"
        )
    return sorted([*folder.rglob("*.safetensors"), *folder.rglob(AGGREGATED_FILE)])


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{name}."))
        else:
            flat[name] = value
    return flat


class _Sized(NamedTuple):
    """How a msgpack type says its length, and what it holds."""

    kind: str
    n_bytes: int


_SIZED: Mapping[int, _Sized] = {
    **{0xC4 + i: _Sized("bytes", 1 << i) for i in range(3)},
    **{0xC7 + i: _Sized("extension", 1 << i) for i in range(3)},
    **{0xD9 + i: _Sized("text", 1 << i) for i in range(3)},
    **{0xDC + i: _Sized("list", 2 << i) for i in range(2)},
    **{0xDE + i: _Sized("map", 2 << i) for i in range(2)},
}
_NUMBERS: Mapping[int, str] = {
    **{0xCA: ">f", 0xCB: ">d", 0xCC: ">B", 0xCD: ">H", 0xCE: ">I", 0xCF: ">Q"},
    **{0xD0: ">b", 0xD1: ">h", 0xD2: ">i", 0xD3: ">q"},
}
_CONSTANTS: Mapping[int, object] = {0xC0: None, 0xC2: False, 0xC3: True}


class _Reader:
    """Reads msgpack from bytes; a length beyond the end is an error, not a short read."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._at, self._where = memoryview(data), 0, where

    def done(self) -> bool:
        return self._at == len(self._data)

    def value(self) -> Any:
        first = self._take(1)[0]
        if first <= 0x7F or first >= 0xE0:
            return first if first <= 0x7F else first - 0x100
        if first in _CONSTANTS:
            return _CONSTANTS[first]
        if first in _NUMBERS:
            layout = _NUMBERS[first]
            return struct.unpack(layout, self._take(struct.calcsize(layout)))[0]
        if 0xD4 <= first <= 0xD8:
            return self._extension(1 << (first - 0xD4))
        if first in _SIZED:
            sized = _SIZED[first]
            return self._container(sized.kind, int.from_bytes(self._take(sized.n_bytes), "big"))
        short = {0x8: ("map", 0x0F), 0x9: ("list", 0x0F), 0xA: ("text", 0x1F), 0xB: ("text", 0x1F)}
        if first >> 4 not in short:
            raise self._error(f"the byte {first:#x} begins nothing")
        kind, mask = short[first >> 4]
        return self._container(kind, first & mask)

    def _container(self, kind: str, n: int) -> Any:
        if kind == "map":
            return {str(self.value()): self.value() for _ in range(n)}
        if kind == "list":
            return [self.value() for _ in range(n)]
        if kind == "extension":
            return self._extension(n)
        taken = bytes(self._take(n))
        return taken.decode() if kind == "text" else taken

    def _extension(self, n: int) -> Any:
        code = self._take(1)[0]
        inner = bytes(self._take(n))
        if code != ARRAY_EXTENSION:
            raise self._error(f"extension {code} is no array")
        shape, dtype, content = _Reader(inner, self._where).value()
        name = dtype.decode() if isinstance(dtype, bytes) else dtype
        return np.frombuffer(content, dtype=np.dtype(name)).reshape(shape)

    def _take(self, n: int) -> memoryview:
        if self._at + n > len(self._data):
            raise self._error("it ends too early")
        taken = self._data[self._at : self._at + n]
        self._at += n
        return taken

    def _error(self, what: str) -> CheckpointError:
        return CheckpointError(
            f"{self._where}: not flax's msgpack: {what}, at byte {self._at}. Fetch the checkpoint again."
        )


def unpack(data: bytes, *, where: str) -> Any:
    """Return what msgpack holds, arrays as numpy's.

    Raises:
        CheckpointError: it is something else, damaged, or has arrays in several parts.
    """
    reader = _Reader(data, where)
    try:
        value = reader.value()
    except (ValueError, TypeError, RecursionError, AttributeError) as exc:  # of text, types and shapes
        raise CheckpointError(
            f"{where}: not flax's msgpack: {exc!s:.200}. Fetch the checkpoint again."
        ) from exc
    if not reader.done():
        raise CheckpointError(f"{where}: not flax's msgpack: something follows its end.")
    if isinstance(value, dict) and any(CHUNKED in key for key in _flat(value)):
        raise CheckpointError(f"{where}: holds arrays in several parts, which are not read. {EXPORT_HINT}")
    return value
