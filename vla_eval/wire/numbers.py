"""Which vectors of numbers are a state: of what type, finite, and with rotations that are rotations.

This file runs with Python 3.8 and numpy 1.22, and imports nothing else: `mikasa_vla_client` ships it, too.
Both ends of a connection check with it what they send and what they are sent.
"""

from __future__ import annotations

from typing import Any, Iterator, Sequence  # Any: a message may hold anything

import numpy as np

FLOAT_TYPES = ("float32", "float64")
"""Of a state. float16 is too coarse for positions of an arm, and float128 is another type on each machine."""
UNIT_VECTORS = (("qw", "qx", "qy", "qz"), ("r11", "r21", "r31"), ("r12", "r22", "r32"))
"""Names of numbers that together have length 1: a quaternion, and two columns of a rotation matrix."""
MAX_LENGTH_ERROR = 0.01  # of a length of 1: float32 rounds to 1e-7, and no rounding to two decimals is more


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
