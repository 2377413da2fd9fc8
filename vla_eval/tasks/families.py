"""Families of tasks: ids without a number, for which the arguments say which task it is.

`RememberColor` with `n_items=4` is a task that has no row in the catalogue. A family is made from one
of its rows; knows nothing of simulators.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.spec import TaskSpec

CHOICE_ARGUMENTS = ("strict_choice", "show_cue")
"""Arguments of tasks with candidates alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """How a family is made.

    Attributes:
        id: its name.
        row: id of the row of the catalogue that it is made from.
        open_arguments: what has to be chosen; everything else is as in the row.
        min_response_steps: see `TaskSpec`. So many that with the arguments of any row of the family the
            horizon is that row's.
    """

    id: str
    row: str
    open_arguments: tuple[str, ...]
    min_response_steps: int


FAMILY_TABLE = (
    Family(id="RememberColor", row="RememberColor3-v0", open_arguments=("n_items",), min_response_steps=50),
    Family(id="RememberShape", row="RememberShape3-v0", open_arguments=("n_items",), min_response_steps=50),
    Family(
        id="RememberShapeAndColor",
        row="RememberShapeAndColor3x2-v0",
        open_arguments=("n_shapes", "n_colors"),
        min_response_steps=50,
    ),
    Family(id="BunchOfColors", row="BunchOfColors3-v0", open_arguments=("n_shown",), min_response_steps=110),
    Family(id="SeqOfColors", row="SeqOfColors3-v0", open_arguments=("n_shown",), min_response_steps=80),
    Family(id="ChainOfColors", row="ChainOfColors3-v0", open_arguments=("n_shown",), min_response_steps=80),
    *(
        Family(id=f"ShellGame{mode}", row=f"ShellGame{mode}-v0", open_arguments=(), min_response_steps=85)
        for mode in ("Touch", "Push", "Pick")
    ),
    *(
        Family(
            id=f"Intercept{mode}",
            row=f"Intercept{mode}Medium-v0",
            open_arguments=("velocity_range_m_s",),
            min_response_steps=90,
        )
        for mode in ("", "Grab")
    ),
    *(
        Family(
            id=f"Rotate{mode}",
            row=f"Rotate{mode}Pos-v0",
            open_arguments=("angle_range_rad", "signed"),
            min_response_steps=90,
        )
        for mode in ("Lenient", "Strict")
    ),
    Family(id="TakeItBack", row="TakeItBack-v0", open_arguments=(), min_response_steps=180),
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
        open_arguments=family.open_arguments,
        min_response_steps=family.min_response_steps,
    )


def check_arguments(spec: TaskSpec, given: Collection[str], rows: Iterable[TaskSpec]) -> None:
    """Raise what can be said of a task's arguments by their names, without a simulator.

    Args:
        spec: a row of the catalogue, or a family.
        given: names of the user's arguments.
        rows: the catalogue, for the message.

    Raises:
        TaskArgumentError: an argument without which it is not known which task is meant; or one for tasks
            with candidates, and this one has none.
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
