"""Durations as arguments of a task: a number of control steps, or a range to draw from per episode."""

from collections.abc import Sequence

from vla_eval.errors import TaskArgumentError

StepRange = int | Sequence[int]


def step_range(name: str, value: StepRange) -> tuple[int, int]:
    """Return (least, most) of a duration in control steps given as a number or as a pair.

    Raises:
        TaskArgumentError: not a whole number ≥ 0, nor a pair of such numbers in order.
    """
    pair = (value, value) if isinstance(value, int) else tuple(value)
    if len(pair) != 2 or not all(isinstance(v, int) and v >= 0 for v in pair) or pair[0] > pair[1]:
        raise TaskArgumentError(
            f"{name}={value!r}: expected a number of control steps ≥ 0, or a pair (least, most) of them."
        )
    return int(pair[0]), int(pair[1])
