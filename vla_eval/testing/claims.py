"""Raise the error for a violated requirement."""

import numpy as np

from vla_eval.core import Observation
from vla_eval.errors import ConformanceError


def claim(kept: bool, promise: str, found: str = "", *, advice: str = "") -> None:
    """Raise `ConformanceError`, with what was found and an advice, unless the promise is kept."""
    if not kept:
        raise ConformanceError(f"{promise}{f' Found: {found}.' if found else ''}{advice and f' {advice}'}")


def same_observation(first: Observation, second: Observation) -> bool:
    """Whether two observations are bit-equal in states and in the images both of them hold."""
    states = all(np.array_equal(first.state[name], second.state[name]) for name in first.state)
    images = all(
        np.array_equal(first.images[name], second.images[name]) for name in first.images if second.images
    )
    return first.step == second.step and first.state.keys() == second.state.keys() and states and images
