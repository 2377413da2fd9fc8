"""Families of tasks: ids without a number; the arguments specify the task.

`RememberColor` with `n_items=4` is a task that has no row in the catalogue. A family is made from one
of its rows; knows nothing of simulators.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from vla_eval.tasks.spec import TaskSpec


class Family(NamedTuple):
    """How a family is made."""

    id: str
    row: str  # id of the row of the catalogue that it is made from
    open_arguments: tuple[str, ...]  # required arguments; everything else is as in the row
    min_response_steps: int  # as in `TaskSpec`; with the arguments of any row the horizon is that row's


FAMILY_TABLE = (
    Family("RememberColor", "RememberColor3-v0", ("n_items",), 50),
    Family("RememberShape", "RememberShape3-v0", ("n_items",), 50),
    Family("RememberShapeAndColor", "RememberShapeAndColor3x2-v0", ("n_shapes", "n_colors"), 50),
    Family("RememberObject", "RememberObject3-v0", ("n_items",), 50),
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
    families = {}
    for family in FAMILY_TABLE:
        row, is_open = rows[family.row], bool(family.open_arguments)
        families[family.id] = replace(
            row,
            id=family.id,
            kwargs={name: value for name, value in row.kwargs.items() if name not in family.open_arguments},
            description=f"{row.description} Numbers as the arguments say." if is_open else row.description,
            chance_success=None if is_open else row.chance_success,
            seen_in_one_frame=None if is_open else row.seen_in_one_frame,  # speeds: known by the row alone
            open_arguments=family.open_arguments,
            min_response_steps=family.min_response_steps,
        )
    return families
