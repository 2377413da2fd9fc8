"""What the arguments of a task can be, alone (types) and together: its class checks it, planning before it.

Knows nothing of simulators.
"""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple, get_args

from vla_eval.control_modes import EE_DELTA_POS, EE_DELTA_POSE
from vla_eval.errors import TaskArgumentError
from vla_eval.strict.bounds import MAX_IMAGE_SIZE_PX, MAX_STEPS, MIN_IMAGE_SIZE_PX
from vla_eval.tasks.objects.item_names import COLOR_NAMES, MIXED_SHAPE_NAMES, N_MIXED_COLORS, THING_NAMES
from vla_eval.tasks.objects.layout import GOAL_X_M, START_BANDS_Y_M, START_X_M

MAX_SPEED_M_S = 10.0  # of a ball; it crosses the table in a quarter of a second


class Limits(NamedTuple):
    """The least and the most that a number can be; with `above`, the least itself is too small.

    `why`: what would be beyond them, for the message.
    """

    least: float
    most: float = math.inf
    above: bool = False
    why: str = ""

    def hold(self, number: float) -> bool:
        """Return whether the number can be this."""
        return (self.least < number if self.above else self.least <= number) and number <= self.most

    def __str__(self) -> str:
        if math.isinf(self.most):
            return f"a number > {self.least:g}" if self.above else f"a number ≥ {self.least:g}"
        if self.above:
            return f"> {self.least:g} and at most {self.most:g}{self.why}"
        return f"{self.least:g} to {self.most:g}{self.why}"


Positive = Annotated[float, Limits(0, above=True)]
NotNegative = Annotated[int, Limits(0)]
ItemCount = Annotated[int, Limits(2, len(COLOR_NAMES))]  # one per colour, or per shape: there are as many
ThingCount = Annotated[int, Limits(2, len(THING_NAMES))]
ClutterCount = Annotated[int, Limits(0, len(THING_NAMES))]
ShownCount = Annotated[int, Limits(1, len(COLOR_NAMES))]
MixedShapeCount = Annotated[int, Limits(1, len(MIXED_SHAPE_NAMES))]
MixedColorCount = Annotated[int, Limits(1, N_MIXED_COLORS)]
BodySize = Annotated[float, Limits(0, 0.5, above=True)]  # half an edge, or a radius, m
GoalRadius = Annotated[
    float,
    Limits(
        0,
        GOAL_X_M[0] - START_X_M[1],
        above=True,
        why=", or the cube can lie in the goal region from the start",
    ),
]
ImageSize = Annotated[int, Limits(MIN_IMAGE_SIZE_PX, MAX_IMAGE_SIZE_PX, why=" pixels")]
StepCount = Annotated[int, Limits(0, MAX_STEPS)]
SomeSteps = Annotated[int, Limits(1, MAX_STEPS)]
# Neighbours may lie 6 cm apart: larger ones would overlap.
CubeHalfSize = Annotated[float, Limits(0.01, 0.03)]
MeshScale = Annotated[float, Limits(0, 1e6, above=True)]  # from nanometres to metres, and the other way
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


def n_swaps(**arguments: Any) -> int:  # Any: plain data of many types
    """Return how many other cues the same scene could have, by those arguments that say it."""
    match arguments:
        case {"velocity_range_m_s": (least, most)}:  # a speed half of the range away
            return int(most > least)
        case {"angle_range_rad": (least, most), "angle_threshold_rad": threshold, "signed": signed}:
            # The other sign, or an angle half of the range away. None if an angle could then be right for
            # both: the tolerances of the two must not overlap.
            if signed:
                return int(most <= math.pi - threshold)
            return int((most - least) / 2 >= 2 * threshold)
        case {"n_items": n_items}:  # another item; instead of the first, if several are shown
            return int(n_items) - int(arguments.get("n_shown", 1))
    return len(START_BANDS_Y_M) - 1  # TakeItBack: the cube in another band


def check_together(**arguments: Any) -> None:  # Any: plain data of many types
    """Raise `TaskArgumentError` if arguments of a task do not go together, by the rules that name only these.

    A class gives what it takes itself, planning all arguments of the task, and both what follows from them:
    `n_swaps`, `one_by_one`, `least_delay`.
    """
    for rule in RULES:
        names = inspect.signature(rule).parameters
        wrong = names.keys() <= arguments.keys() and rule(*(arguments[name] for name in names))
        if wrong:
            raise TaskArgumentError(str(wrong))


def _swap(name: str, swap: int, *, most: int) -> bool | str:
    other = "as the cue has no other value with these arguments" if most == 0 else "0 for no swap"
    return not 0 <= swap <= most and f"{name}={swap}: expected 0 to {most}, {other}."


def _pair(numbers: Sequence[float]) -> tuple[float, float]:
    """Return two numbers in order; else a pair that is not."""
    return (numbers[0], numbers[1]) if len(numbers) == 2 else (1.0, 0.0)


RULES: tuple[Callable[..., bool | str], ...] = (
    lambda n_shapes, n_colors: (
        n_shapes * n_colors < 2 and "n_shapes × n_colors is 1: expected at least two items to choose among."
    ),
    lambda official_3x2, n_shapes, n_colors: (
        official_3x2
        and (n_shapes, n_colors) != (3, 2)
        and f"official_3x2 with n_shapes={n_shapes}, n_colors={n_colors}: it swaps 3 and 2 only."
    ),
    lambda n_shown, n_items: n_shown > n_items and f"n_shown={n_shown}: expected at most n_items={n_items}.",
    lambda gap_steps, one_by_one: (
        gap_steps and not one_by_one and f"gap_steps={gap_steps}: the cubes of this task are shown together."
    ),
    lambda phase_gate_success, n_shown: (
        not phase_gate_success
        and "phase_gate_success=False: in these tasks touches count only in the response phase, as in the "
        "official code. Remove this argument."
    ),
    lambda shuffle_cue, n_shown, one_by_one: (
        shuffle_cue
        and not (one_by_one and n_shown > 1)
        and "shuffle_cue: the cue of this task is not several cubes in turn."
    ),
    lambda swap_order, n_shown, one_by_one: _swap(
        "swap_order", swap_order, most=n_shown - 1 if one_by_one else 0
    ),
    lambda goal_threshold_m, push_distance_m: (
        goal_threshold_m >= push_distance_m
        and f"goal_threshold_m={goal_threshold_m}: expected > 0 and less than "
        f"push_distance_m={push_distance_m}, or the mug stands in the goal before anything is done."
    ),
    lambda goal_threshold_m, lift_height_m: (
        goal_threshold_m is not None
        and goal_threshold_m >= lift_height_m
        and f"goal_threshold_m={goal_threshold_m}: expected > 0 and less than "
        f"lift_height_m={lift_height_m}, or the mug is at the goal before anything is done."
    ),
    lambda velocity_range_m_s: (
        not 0 < _pair(velocity_range_m_s)[0] <= _pair(velocity_range_m_s)[1] <= MAX_SPEED_M_S
        and f"velocity_range_m_s={velocity_range_m_s!r}: expected (least, most) with 0 < least ≤ most ≤ "
        f"{MAX_SPEED_M_S:g}."
    ),
    lambda angle_range_rad, angle_threshold_rad: (
        not angle_threshold_rad <= _pair(angle_range_rad)[0] <= _pair(angle_range_rad)[1] <= math.pi
        and f"angle_range_rad={angle_range_rad!r}: expected (least, most) in rad with "
        f"{angle_threshold_rad:g} ≤ least ≤ most ≤ π, where {angle_threshold_rad:g} is angle_threshold_rad."
    ),
    lambda signed, official_signs: (
        official_signs and not signed and "official_signs without signed: all angles are positive then."
    ),
    lambda swap_cue, n_swaps: _swap("swap_cue", swap_cue, most=n_swaps),
    lambda distract_steps, least_delay: (
        distract_steps > least_delay
        and f"distract_steps={distract_steps}: expected 0 to {least_delay}, the steps of the delay."
    ),
    lambda distract_steps, swap_cue, n_swaps: (
        distract_steps
        and n_swaps <= int(swap_cue > 0)
        and f"distract_steps={distract_steps}: every item is right or shown, so none is left for it."
    ),
    lambda clutter, n_free_things: (
        clutter > n_free_things
        and f"clutter={clutter}: expected at most {n_free_things}: the other everyday things are candidates "
        "of this task."
    ),
    lambda clutter, n_free_places: (
        clutter > n_free_places
        and f"clutter={clutter}: expected at most {n_free_places}: no more places of the table are clear of "
        "what this task uses, and in the base camera's view."
    ),
    lambda meshes, mesh_scale, mesh_holes: (
        meshes is None
        and (mesh_scale != 1 or mesh_holes)
        and f"mesh_scale={mesh_scale:g}, mesh_holes={mesh_holes} without meshes: expected a folder to which "
        "they apply. Set env.meshes, or remove them."
    ),
    lambda move_in_delay, control_mode: (
        move_in_delay
        and control_mode not in (EE_DELTA_POSE, EE_DELTA_POS)
        and f"move_in_delay with control_mode={control_mode!r}: its motion is given in {EE_DELTA_POSE} and "
        f"{EE_DELTA_POS} only. Use one of these modes, or leave it out."
    ),
)
"""Each says what is wrong with the arguments that it names, or False. Single numbers are checked before."""
