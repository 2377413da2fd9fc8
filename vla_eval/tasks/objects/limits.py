"""Which numbers an argument of a task can be, as types: its class checks them, and planning before it.

Knows nothing of simulators.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, get_args

from vla_eval.errors import TaskArgumentError
from vla_eval.strict.bounds import MAX_STEPS
from vla_eval.tasks.objects.item_names import COLOR_NAMES, MIXED_SHAPE_NAMES, N_MIXED_COLORS


class Limits(NamedTuple):
    """The least and the most that a number can be; with `above`, the least itself is too small."""

    least: float
    most: float = math.inf
    above: bool = False

    def hold(self, number: float) -> bool:
        """Return whether the number can be this."""
        return (self.least < number if self.above else self.least <= number) and number <= self.most

    def __str__(self) -> str:
        if math.isinf(self.most):
            return f"a number > {self.least:g}" if self.above else f"a number ≥ {self.least:g}"
        return (
            f"> {self.least:g} and at most {self.most:g}"
            if self.above
            else f"{self.least:g} to {self.most:g}"
        )


Positive = Annotated[float, Limits(0, above=True)]
NotNegative = Annotated[int, Limits(0)]
ItemCount = Annotated[int, Limits(2, len(COLOR_NAMES))]  # one per colour, or per shape: there are as many
ShownCount = Annotated[int, Limits(1, len(COLOR_NAMES))]
MixedShapeCount = Annotated[int, Limits(1, len(MIXED_SHAPE_NAMES))]
MixedColorCount = Annotated[int, Limits(1, N_MIXED_COLORS)]
DwellSteps = Annotated[int, Limits(1, MAX_STEPS)]
# Neighbours may lie 6 cm apart: larger ones would overlap.
CubeHalfSize = Annotated[float, Limits(0.01, 0.03)]
CarryHeight = Annotated[float, Limits(0, 0.5)]  # 0: need not be lifted; the most is what the arm reaches
LiftHeight = Annotated[float, Limits(0, 0.4, above=True)]

LIMITED: Mapping[str, Any] = {  # Any: type annotations
    name: value for name, value in globals().items() if isinstance(value, type(Positive))
}
"""Name of each of these types -> the type."""


def check(kind: Any, **numbers: object) -> None:  # Any: one of these types
    """Raise `TaskArgumentError` unless every number, by the name of its argument, is within the limits."""
    number_type, limits = get_args(kind)
    fitting = (int, float) if number_type is float else int
    for name, number in numbers.items():
        if isinstance(number, bool) or not isinstance(number, fitting) or not limits.hold(number):
            raise TaskArgumentError(f"{name}={number!r}: expected {limits}.")
