"""Numbers that no message may hold, written as a program without checks writes them."""

from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np

NOT_FINITE = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}
TYPES: dict[str, Any] = {
    "float16": np.float16,
    "longdouble": np.longdouble,
    "complex64": np.complex64,
    "complex128": np.complex128,
    "object": object,
    "text": "U4",
    "time": "M8[s]",
}


def packed(message: Any) -> bytes:
    """Return a message as openpi packs it, whatever numbers it holds."""
    data: bytes = msgpack.packb(message, default=_marked)
    return data


def _marked(value: Any) -> dict[bytes, Any]:
    array, dtype = np.asarray(value), np.asarray(value).dtype.str
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": array.tobytes(), b"dtype": dtype}
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": dtype, b"shape": list(array.shape)}


def hostile_vectors(good: np.ndarray, *, allowed: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield arrays that differ from a good one in one number or in their type.

    Args:
        good: an array of floats.
        allowed: the types that are none of these.
    """
    for name, number in NOT_FINITE.items():
        for place in (0, good.size - 1):
            bad = good.copy()
            bad.flat[place] = number
            yield f"{name}[{place}]", bad
            yield f"{name}[{place}] as float64", bad.astype(np.float64)
    too_large = good.astype(np.float64)
    too_large.flat[0] = 1e39  # the largest float32 is 3.4e38
    yield "more than float32 holds", too_large
    for name, dtype in TYPES.items():
        if name not in allowed:
            yield (
                name,
                np.ones(good.shape).astype(int).astype(dtype) if name == "time" else good.astype(dtype),
            )
    yield "a list of None", [None] * good.size
    yield "a list of text", [str(number) for number in good.flat]


def hostile_scalars() -> Iterator[tuple[str, Any]]:
    """Yield what is no whole number."""
    yield from NOT_FINITE.items()
    for name, dtype in TYPES.items():
        yield name, np.ones((), int).astype(dtype) if name == "object" else np.ones((), int).astype(dtype)[()]
    yield "a list", [1]
    yield "a fraction", 0.5
