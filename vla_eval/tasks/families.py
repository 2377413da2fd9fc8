"""Families of tasks: ids without a number; the arguments specify the task.

`RememberColor` with `n_items=4` is a task that has no row in the catalogue. A family is made from one
of its rows; knows nothing of simulators.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from vla_eval.control_modes import action_spec, control_mode_of
from vla_eval.errors import RecipeError, TaskArgumentError
from vla_eval.strict.bounds import MAX_STEPS
from vla_eval.strict.decoding import check_value
from vla_eval.tasks.interface import IMAGE_SIZE, checked_image_size
from vla_eval.tasks.spec import TaskSpec

CHOICE_ARGUMENTS = ("strict_choice", "show_cue", "cue_after_steps")
"""Arguments that only tasks with candidates have."""


class Family(NamedTuple):
    """How a family is made.

    Attributes:
        id: its name.
        row: id of the row of the catalogue that it is made from.
        open_arguments: required arguments; everything else is as in the row.
        min_response_steps: see `TaskSpec`. Chosen such that with the arguments of any row of the family
            the horizon is that row's.
    """

    id: str
    row: str
    open_arguments: tuple[str, ...]
    min_response_steps: int


FAMILY_TABLE = (
    Family("RememberColor", "RememberColor3-v0", ("n_items",), 50),
    Family("RememberShape", "RememberShape3-v0", ("n_items",), 50),
    Family("RememberShapeAndColor", "RememberShapeAndColor3x2-v0", ("n_shapes", "n_colors"), 50),
    Family("BunchOfColors", "BunchOfColors3-v0", ("n_shown",), 110),
    Family("SeqOfColors", "SeqOfColors3-v0", ("n_shown",), 80),
    Family("ChainOfColors", "ChainOfColors3-v0", ("n_shown",), 80),
    *(Family(f"ShellGame{mode}", f"ShellGame{mode}-v0", (), 85) for mode in ("Touch", "Push", "Pick")),
    *(
        Family(f"Intercept{mode}", f"Intercept{mode}Medium-v0", ("velocity_range_m_s",), 90)
        for mode in ("", "Grab")
    ),
    *(
        Family(f"Rotate{mode}", f"Rotate{mode}Pos-v0", ("angle_range_rad", "signed"), 90)
        for mode in ("Lenient", "Strict")
    ),
    Family("TakeItBack", "TakeItBack-v0", (), 180),
)


def make_families(rows: Mapping[str, TaskSpec]) -> dict[str, TaskSpec]:
    """Return family id -> its row, made from the rows of the catalogue."""
    return {family.id: _make_family(family, rows[family.row]) for family in FAMILY_TABLE}


def _make_family(family: Family, row: TaskSpec) -> TaskSpec:
    is_open = bool(family.open_arguments)
    return replace(
        row,
        id=family.id,
        kwargs={name: value for name, value in row.kwargs.items() if name not in family.open_arguments},
        description=f"{row.description} Numbers as the arguments say." if is_open else row.description,
        chance_success=None if is_open else row.chance_success,
        seen_in_one_frame=None if is_open else row.seen_in_one_frame,  # speeds are known by the row alone
        open_arguments=family.open_arguments,
        min_response_steps=family.min_response_steps,
    )


def check_arguments(spec: TaskSpec, given: Mapping[str, object], rows: Iterable[TaskSpec]) -> None:
    """Check the names of a task's arguments, durations, control mode and image size, without a simulator.

    Args:
        spec: a row of the catalogue, or a family.
        given: the user's arguments.
        rows: the catalogue, for the message.

    Raises:
        TaskArgumentError: a required argument of a family is missing; or an argument needs candidates,
            and this task has none; or a duration is not a number of control steps; or a size is impossible.
        UnknownNameError: there is no such control mode.
    """
    missing = [name for name in spec.open_arguments if name not in given]
    if missing:
        known = [row.id for row in rows if row.id.startswith(spec.id) and row.entry_point == spec.entry_point]
        wanted = " ".join(f"--set env.{name}=…" for name in missing)
        raise TaskArgumentError(
            f"{spec.id} is a family of tasks: {', '.join(missing)} must say which one. Add {wanted}, or name "
            f"one of {', '.join(known)}."
        )
    of_choices = [f"env.{name}" for name in CHOICE_ARGUMENTS if name in given]
    if of_choices and spec.candidates is None:
        raise TaskArgumentError(
            f"{', '.join(of_choices)}: {spec.id}: there are no candidates to choose among. Use this task "
            f"without it, in a run of its own."
        )
    action_spec(control_mode_of(given))
    if IMAGE_SIZE in given:
        checked_image_size(given[IMAGE_SIZE], task=spec.id)
    for name, value in given.items():
        if name.endswith("_steps"):
            _check_steps(name, value, task=spec.id)


def check_argument(hint: Any, value: object, *, name: str, task: str) -> None:  # Any: a type annotation
    """Raise `TaskArgumentError` unless an argument is of the type that the task declares for it."""
    try:
        check_value(hint, value, path=name)
    except RecipeError as exc:
        raise TaskArgumentError(f"{task}: {exc}") from exc


def _check_steps(name: str, value: object, *, task: str) -> None:
    """Raise unless this is a number of control steps, or a pair of them."""
    least = 1 if name == "horizon_steps" else 0
    for steps in value if isinstance(value, list | tuple) else (value,):
        if not isinstance(steps, int) or isinstance(steps, bool) or not least <= steps <= MAX_STEPS:
            raise TaskArgumentError(
                f"{task}: {name}={value!r:.80}: expected a whole number of control steps, {least} to "
                f"{MAX_STEPS}, or, where a duration may be drawn, a pair of them."
            )
