"""Which of the official 90 tasks have scripted controls: the expert, and what it is given of the true state.

The experts are those of this package's own tasks of the same kind. A family without a row here has none.
"""

import re
from typing import Any, NamedTuple  # Any: fields of a row of the catalogue

from vla_eval.tasks.catalogs.spatial_catalog import BALL_SPEEDS_M_S, SPATIAL_TASKS
from vla_eval.tasks.spec import TrueState

_ITEMS_SEEN = "poses of all items and which one is right; moves once the choice has appeared"
_MUGS_SEEN = "poses of all mugs and which one is right; moves once the mugs stand still"


class Controls(NamedTuple):
    """The controls of a family of official tasks.

    Attributes:
        expert: `module:attribute`.
        true_state: what controls are given.
        sees: the same in words.
    """

    expert: str
    true_state: TrueState
    sees: str


_CHOICES = {
    "Remember": Controls("vla_eval.oracles.hover:CUBES", "items", _ITEMS_SEEN),
    "FindImposter": Controls("vla_eval.oracles.hover:CUBES", "items", _ITEMS_SEEN),
    "ShellGamePush": Controls("vla_eval.oracles.push:MUGS", "mugs", _MUGS_SEEN),
    "ShellGame": Controls("vla_eval.oracles.hover:MUGS", "mugs", _MUGS_SEEN),
}
_MOVING: dict[str, TrueState] = {"Intercept": "ball", "Rotate": "peg", "TakeItBack": "cube"}
_OWN = {row.id.removesuffix("-v0"): row for row in SPATIAL_TASKS}
_N_MUGS = 3


def control_fields(name: str) -> dict[str, Any]:
    """Return the fields of a catalogue row that its controls need; empty if there are none.

    Args:
        name: of the task, such as `RememberColor3-VLA-v0`.
    """
    task = name.partition("-")[0]
    for prefix, controls in _CHOICES.items():
        if task.startswith(prefix):
            n = n_candidates(task)
            return {**_fields(controls), "candidate_counts": {"n_items": n}, "chance_success": 1 / n}
    for prefix, true_state in _MOVING.items():
        if task.startswith(prefix):
            own, speeds = _OWN[task], _speeds(task)
            fields = _fields(Controls(own.oracle, true_state, own.oracle_sees))
            # Not of TakeItBack: the official state does not say which colour the disc has.
            seen = {"seen_in_one_frame": own.seen_in_one_frame} if speeds else {}
            return {**fields, **seen, "turns_wrist": own.turns_wrist, "kwargs": speeds}
    return {}


def n_candidates(task: str) -> int:
    """Return among how many objects one has to choose: `RememberColor3` 3, `RememberShapeAndColor5x3` 15.

    The official 3x2 has two shapes in three colours.
    """
    numbers = re.search(r"(\d+)(?:x(\d+))?$", task)
    if numbers is None:
        return _N_MUGS
    return int(numbers[1]) * int(numbers[2] or 1)


def _fields(controls: Controls) -> dict[str, Any]:
    return {
        "oracle": controls.expert,
        "oracle_sees": controls.sees,
        "true_state": controls.true_state,
    }


def _speeds(task: str) -> dict[str, Any]:
    """Return the range of the ball's initial speed, if there is one: the same as in this package's task."""
    mode = task.removeprefix("InterceptGrab").removeprefix("Intercept")
    return {"velocity_range_m_s": BALL_SPEEDS_M_S[mode]} if mode in BALL_SPEEDS_M_S else {}
