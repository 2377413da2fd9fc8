"""Messages as msgpack with numpy arrays, as openpi's client and server write them.

This file runs with Python 3.8, numpy 1.22 and msgpack 1.0, and imports nothing else: `mikasa_vla_client`
ships it, too. What arrives may be anything: it is read, or refused with a `CodecError`.

An array is a map `{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": (2, 3)}`, a numpy scalar
`{b"__npgeneric__": True, b"data": 1.5, b"dtype": "<f4"}`. The keys may also be text, as others write them.

Source: https://github.com/Physical-Intelligence/openpi/blob/15a9616a00943ada6c20a0f158e3adb39df2ccac/
packages/openpi-client/src/openpi_client/msgpack_numpy.py (the format; the code is not used).
"""

from __future__ import annotations

import math
import re
from typing import Any  # Any: a message may hold anything that msgpack can

import msgpack
import numpy as np

MAX_MESSAGE_BYTES = 64 * 2**20
MAX_DEPTH = 16  # maps and lists inside each other; an observation has 3
MAX_ITEMS = 1_000_000  # of all maps and lists of a message together: an item takes up to 64 bytes of memory
MAX_ARRAY_DIMS = 16

ARRAY, SCALAR = "__ndarray__", "__npgeneric__"
KINDS = "biufSU"  # bool, integers, floats, bytes, text: no objects, no records, no complex numbers, no times
MAX_FLOAT_BYTES = 8  # longer ones ("float128") have other bytes on other machines
# Keys by which arrays are known that other programs have packed.
# Source: https://github.com/lebedov/msgpack-numpy, https://github.com/Crimson-Crow/json-numpy,
# https://github.com/NVIDIA/Isaac-GR00T (gr00t/policy/server_client.py).
DIALECTS = (
    ("msgpack-numpy", frozenset({"nd", "type", "data"})),
    ("msgpack-numpy", frozenset({"complex", "data"})),  # a complex number
    ("json-numpy", frozenset({"__numpy__", "dtype", "shape"})),
    ("Isaac-GR00T", frozenset({"__ndarray_class__", "as_npy"})),
)
_DTYPE = re.compile(r"[<>|=]?[a-zA-Z?][0-9]{0,9}")
_MAX_CODE_POINT = 0x10FFFF
_EXPECTED = (
    "expected arrays as openpi-client packs them (`openpi_client.msgpack_numpy`, not the package "
    "msgpack-numpy): {b'__ndarray__': True, b'data': array.tobytes(), b'dtype': array.dtype.str, "
    "b'shape': array.shape}"
)


class CodecError(ValueError):
    """A message cannot be written or read."""


def packb(message: Any, text_markers: bool = False) -> bytes:
    """Return a message of maps, lists, text, bytes, numbers, None, numpy arrays and scalars as bytes.

    `text_markers`: write the markers of arrays as text, and scalars as plain numbers, for programs that read
    nothing else. A `CodecError` if it holds something else, or is too large.
    """
    try:
        data = msgpack.packb(_plain(message, 0, text_markers), use_bin_type=True)
    except CodecError:
        raise
    except (ValueError, OverflowError, TypeError, MemoryError) as exc:
        raise CodecError(f"the message cannot be packed: {exc!s:.200}") from exc
    if len(data) > MAX_MESSAGE_BYTES:
        raise CodecError(_too_large(len(data)))
    return bytes(data)


def _plain(value: Any, depth: int, text_markers: bool) -> Any:
    """Return what msgpack itself can write."""
    if depth >= MAX_DEPTH and isinstance(value, (dict, list, tuple)):
        raise CodecError(f"nesting of more than {MAX_DEPTH} levels")
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise CodecError(f"expected text as the key of a map, found {key!r:.80}")
        return {key: _plain(item, depth + 1, text_markers) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, depth + 1, text_markers) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _marked(value, text_markers)
    if value is None or isinstance(value, (bool, int, float, str, bytes)):
        return value
    raise CodecError(f"expected plain data or arrays, found {type(value).__name__}")


def _marked(value: Any, text_markers: bool) -> Any:
    """Return an array or a numpy scalar as a map with a marker."""
    _check_kind(value.dtype)
    if value.nbytes > MAX_MESSAGE_BYTES:
        raise CodecError(_too_large(value.nbytes))
    fields: dict[str, Any]
    if isinstance(value, np.ndarray):
        # `tobytes` writes C order, whatever the order in memory.
        fields = {ARRAY: True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}
    elif text_markers:
        return value.item()
    else:
        fields = {SCALAR: True, "data": value.item(), "dtype": value.dtype.str}
    return fields if text_markers else {key.encode(): item for key, item in fields.items()}


def unpackb(data: Any) -> Any:
    """Return the message that bytes hold, arrays new and writable; a `CodecError` for whatever is refused."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise CodecError(_too_large(len(data)))
    budget = _Budget()
    try:
        message = msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,  # text or bytes
            object_pairs_hook=budget.read_map,
            list_hook=budget.read_list,
            ext_hook=_refuse_extension,
        )
    except CodecError:
        raise
    except RecursionError:
        raise CodecError(f"nesting of more than {MAX_DEPTH} levels") from None
    except UnicodeDecodeError:
        raise CodecError(
            f"text that is not UTF-8. Pack bytes with `use_bin_type=True`; {_EXPECTED}"
        ) from None
    except (ValueError, TypeError, OverflowError, MemoryError, msgpack.UnpackException) as exc:
        raise CodecError(f"the bytes are not a message in msgpack: {exc!s:.200}") from exc
    _check_nesting(message)
    return message


class _Budget:
    """Builds maps and lists as they are read, and counts their items."""

    def __init__(self) -> None:
        self._n_items = 0

    def _count(self, n_items: int) -> None:
        self._n_items += n_items + 1
        if self._n_items > MAX_ITEMS:
            raise CodecError(f"more than {MAX_ITEMS} items; expected large data as arrays")

    def read_list(self, items: list[Any]) -> list[Any]:
        self._count(len(items))
        return items

    def read_map(self, pairs: list[tuple[Any, Any]]) -> Any:
        self._count(len(pairs))
        message: dict[str, Any] = {}
        for key, value in pairs:
            name = _text(key)
            if name in message:
                raise CodecError(f"the key {name!r:.80} twice in one map")
            message[name] = value
        if ARRAY in message:
            return _read_array(message)
        if SCALAR in message:
            return _read_scalar(message)
        for name, keys in DIALECTS:
            if keys <= message.keys():
                raise CodecError(f"an array as {name} packs it; {_EXPECTED}")
        return message


def _text(key: Any) -> str:
    if isinstance(key, str):
        return key
    try:
        return bytes(key).decode("utf-8")
    except UnicodeDecodeError:
        raise CodecError(f"expected text as the key of a map, found {key!r:.80}") from None


def _read_array(fields: dict[str, Any]) -> np.ndarray[Any, Any]:
    data, shape = fields.get("data"), fields.get("shape")
    dtype = _read_dtype(fields.get("dtype"))
    if not isinstance(data, bytes):
        raise CodecError(f"an array: expected its data as bytes, found {type(data).__name__}")
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise CodecError(f"an array: expected its shape as a list of numbers ≥ 0, found {shape!r:.80}")
    # numpy multiplies the sizes that are not 0, also of an array without elements.
    if len(shape) > MAX_ARRAY_DIMS or math.prod(n for n in shape if n) * dtype.itemsize > MAX_MESSAGE_BYTES:
        raise CodecError(f"an array: the shape {shape!r:.80} of {dtype.str} is too large")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise CodecError(
            f"an array: expected {math.prod(shape) * dtype.itemsize} bytes for the shape {shape!r:.80} of "
            f"{dtype.str}, found {len(data)}"
        )
    # Bytes that no value of this type has, which numpy would not notice.
    if dtype.kind == "b" and data and np.frombuffer(data, dtype=np.uint8).max() > 1:
        raise CodecError("an array: expected 0 or 1 for a bool")
    if dtype.kind == "U" and data:
        code_points = np.frombuffer(data, dtype=np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if code_points.max() > _MAX_CODE_POINT:
            raise CodecError("an array: expected text, found a number that is not a character")
    array = np.frombuffer(data, dtype=dtype) if data else np.empty(0, dtype=dtype)
    return array.reshape(shape).astype(dtype.newbyteorder("="))  # `astype` copies


def _read_scalar(fields: dict[str, Any]) -> Any:
    value: Any = fields.get("data")
    dtype = _read_dtype(fields.get("dtype"))
    expected: Any = {"b": bool, "i": int, "u": int, "f": (float, int), "S": bytes, "U": str}[dtype.kind]
    is_number_for_bool = dtype.kind != "b" and isinstance(value, bool)
    if not isinstance(value, expected) or is_number_for_bool:
        raise CodecError(f"a numpy scalar of {dtype.str}: found {value!r:.80}")
    if dtype.kind in "iu" and not np.iinfo(dtype).min <= value <= np.iinfo(dtype).max:
        raise CodecError(f"a numpy scalar of {dtype.str}: {value} is out of its range")
    with np.errstate(over="ignore"):  # a large number becomes infinite, as it does in an array
        return dtype.newbyteorder("=").type(value)


def _read_dtype(text: Any) -> np.dtype[Any]:
    if isinstance(text, bytes):
        text = text.decode("ascii", errors="replace")
    # Only names of one simple type: numpy also takes records and shapes in such a text.
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise CodecError(f"an array: expected a dtype like '<f4', found {text!r:.80}")
    try:
        dtype = np.dtype(text)
    except (TypeError, ValueError) as exc:
        raise CodecError(f"an array: there is no dtype {text!r:.80}") from exc
    _check_kind(dtype)
    if dtype.itemsize == 0:
        raise CodecError(f"an array: the dtype {text!r:.80} has no size")
    return dtype


def _check_kind(dtype: np.dtype[Any]) -> None:
    is_too_long = dtype.kind == "f" and dtype.itemsize > MAX_FLOAT_BYTES
    if dtype.kind not in KINDS or dtype.hasobject or is_too_long:
        raise CodecError(
            f"arrays of dtype {dtype.str!s:.40} are refused; expected bool, integers, floats of at most "
            f"{8 * MAX_FLOAT_BYTES} bits or text"
        )


def _check_nesting(message: Any) -> None:
    """Refuse deep nesting, and anything but plain data; without recursion."""
    level = [message]
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below.extend(value.values())
            elif isinstance(value, list):
                below.extend(value)
            elif isinstance(value, msgpack.Timestamp):
                raise CodecError("expected plain data or arrays, found a time")
        level = [value for value in below if isinstance(value, (dict, list, msgpack.Timestamp))]
        if not level:
            return
    raise CodecError(f"nesting of more than {MAX_DEPTH} levels")


def _refuse_extension(code: int, _data: bytes) -> Any:
    raise CodecError(f"expected plain data or arrays, found an extension of msgpack (type {code})")


def _too_large(n_bytes: int) -> str:
    return f"a message of {n_bytes} bytes, expected at most {MAX_MESSAGE_BYTES} (64 MiB)"
