"""Which arrays are a state (finite, with rotations that are rotations), and which are a memory.

This file runs with Python 3.8 and numpy 1.22, and imports nothing else: `mikasa_vla_client` ships it, too.
Both ends of a connection check with it what they send and what they are sent.
"""

from __future__ import annotations

from typing import Any, Iterator, Mapping, Sequence  # Any: a message may hold anything

import numpy as np

FLOAT_TYPES = ("float32", "float64")
"""Of a state. float16 is too coarse for positions of an arm, and float128 is another type on each machine."""
UNIT_VECTORS = (("qw", "qx", "qy", "qz"), ("r11", "r21", "r31"), ("r12", "r22", "r32"))
"""Names of numbers that together have length 1: a quaternion, and two columns of a rotation matrix."""
MAX_LENGTH_ERROR = 0.01  # of a length of 1: float32 rounds to 1e-7, and no rounding to two decimals is more

MEMORY = "memory"
"""Of `supports`: the policy's memory can be read and replaced. Also the key of a memory in a message."""
GET_MEMORY, SET_MEMORY = "memory/get", "memory/set"
"""Endpoints of a server that supports `MEMORY`."""
COMMITTED_ACTIONS_KEY, COMMITTED_FROZEN_KEY = "committed/actions", "committed/n_frozen"
"""Of a request: the actions left of the chunk under way, (N, A) float32, and how many will be executed in any
case. No published server has such keys: openpi's and LeRobot's take none over a socket."""
CHUNKING_MODES = ("rtc", "prefix")
"""How chunks may join what is committed (docs/real_time.md)."""
MAX_MEMORY_BYTES = 32 * 2**20  # of all arrays of a memory in a message
MAX_MEMORY_ARRAYS = 1024


class NumbersError(ValueError):
    """A vector is not a state."""


def as_state(value: Any, names: Sequence[str]) -> np.ndarray[Any, Any]:
    """Return a state, float32 or float64, as a new float32 array with a number for each name."""
    expected = f"an array of {len(names)} numbers, float32 or float64"
    if not isinstance(value, np.ndarray):
        raise NumbersError(f"expected {expected}; found {type(value).__name__}")
    if value.dtype.name not in FLOAT_TYPES or value.shape != (len(names),):
        raise NumbersError(f"expected {expected}; found {value.dtype} of shape {value.shape}")
    with np.errstate(over="ignore"):  # a number that float32 cannot hold becomes infinite
        state: np.ndarray[Any, Any] = value.astype(np.float32)
    for name, given, held in zip(names, value.tolist(), state.tolist()):
        if not np.isfinite(held):
            raise NumbersError(f"expected finite numbers of float32, found {given} for '{name}'")
    for group, places in unit_vectors(names):
        vector = state[places].astype(np.float64)
        length = float(np.linalg.norm(vector))
        if abs(length - 1) > MAX_LENGTH_ERROR:
            what = "a quaternion" if len(group) == len("wxyz") else "a column of a rotation matrix"
            raise NumbersError(
                f"expected {what}, of length 1, in {', '.join(group)}; found {vector.tolist()}, of length "
                f"{length:.3g}"
            )
    return state


def unit_vectors(names: Sequence[str]) -> Iterator[tuple[tuple[str, ...], list[int]]]:
    """Yield the groups of which all names are there, and their places."""
    places = {name: place for place, name in enumerate(names)}
    for group in UNIT_VECTORS:
        if all(name in places for name in group):
            yield group, [places[name] for name in group]


def memory_problem(memory: Any) -> str | None:
    """Return what is wrong with a memory that arrived in a message, or is to be sent; None: nothing."""
    if not isinstance(memory, Mapping) or len(memory) > MAX_MEMORY_ARRAYS:
        found = type(memory).__name__ if not isinstance(memory, Mapping) else f"{len(memory)} entries"
        return f"expected a map of at most {MAX_MEMORY_ARRAYS} arrays, found {found}"
    for name, array in memory.items():
        is_numbers = isinstance(array, np.ndarray) and array.dtype.kind in "biuf" and array.dtype.isnative
        if not isinstance(name, str) or not is_numbers:
            found = str(array.dtype) if isinstance(array, np.ndarray) else type(array).__name__
            return f"expected arrays of numbers by name, found {name!r:.80}: {found}"
    n_bytes = sum(array.nbytes for array in memory.values())
    if n_bytes > MAX_MEMORY_BYTES:
        return f"expected at most {MAX_MEMORY_BYTES} bytes, found {n_bytes}"
    return None
