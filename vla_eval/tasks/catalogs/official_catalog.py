"""The tasks of the official package `mikasa-robo-suite` 1.0.0, one row each; it need not be installed.

`official_90.csv` has the 90 tasks: ids, horizons and sentences as the classes of the package register and
declare them (MIT licence). The package's own table, `mikasa_robo_vla_envs.csv`, is not in its wheel. The
split follows from the horizon and the memory type from the family, with the counts that its documentation
states. The experts are those of this package's own tasks of the same kind; a family without a row among them
has no scripted controls.

Source: `mikasa_robo_suite/vla/memory_envs` and `rl/memory_envs` of the wheel mikasa-robo-suite 1.0.0,
made from https://github.com/CognitiveAISystems/MIKASA-Robo, tag v1.0.0 (16634db).
"""

import csv
import re
from collections.abc import Iterable
from importlib.resources import files
from typing import Any, cast

from vla_eval.tasks.catalogs.spatial_catalog import BALL_SPEEDS_M_S, SPATIAL_TASKS
from vla_eval.tasks.spec import MemoryType, PhaseSource, TaskSpec, TrueState

NAMESPACE_90 = "mikasa_vla/"
NAMESPACE_ORIGINAL = "mikasa_official/"
TABLE = "official_90.csv"
ENTRY_POINT = "vla_eval.envs.official:OfficialEnv"
_OF_ALL: dict[str, Any] = {
    **{"entry_point": ENTRY_POINT, "success": "as the official package has it"},
    **{"oracle": "", "oracle_sees": "there is none", "candidates": None, "chance_success": None},
}
"""Fields of all official tasks, without controls."""


_ITEMS_SEEN = "poses of all items and which one is right; moves once the choice has appeared"
_MUGS_SEEN = "poses of all mugs and which one is right; moves once the mugs stand still"


_CHOICES: dict[str, tuple[str, TrueState, str]] = {
    # beginning of the name: expert, what it is given of the true state, the same in words
    "Remember": ("vla_eval.oracles.hover:CUBES", "items", _ITEMS_SEEN),
    "FindImposter": ("vla_eval.oracles.hover:CUBES", "items", _ITEMS_SEEN),
    "ShellGamePush": ("vla_eval.oracles.push:MUGS", "mugs", _MUGS_SEEN),
    "ShellGame": ("vla_eval.oracles.hover:MUGS", "mugs", _MUGS_SEEN),
}
_MOVING: dict[str, TrueState] = {"Intercept": "ball", "Rotate": "peg", "TakeItBack": "cube"}
_OWN = {row.id.removesuffix("-v0"): row for row in SPATIAL_TASKS}
_N_MUGS = 3


def control_fields(name: str) -> dict[str, Any]:
    """Return what the controls of a task (`RememberColor3-VLA-v0`) need of a row; empty if there are none."""
    task = name.partition("-")[0]
    for prefix, controls in _CHOICES.items():
        if task.startswith(prefix):
            n = n_candidates(task)
            row = _control_row(*controls) | {"cue_leaves_out": prefix == "FindImposter"}
            return {**row, "candidate_counts": {"n_items": n}, "chance_success": 1 / n}
    for prefix, true_state in _MOVING.items():
        if task.startswith(prefix):
            own, speeds = _OWN[task], _speeds(task)
            fields = _control_row(own.oracle, true_state, own.oracle_sees)
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


def _control_row(expert: str, true_state: TrueState, sees: str) -> dict[str, Any]:
    return {"oracle": expert, "oracle_sees": sees, "true_state": true_state}


def _speeds(task: str) -> dict[str, Any]:
    """Return the range of the ball's initial speed, if there is one: the same as in this package's task."""
    mode = task.removeprefix("InterceptGrab").removeprefix("Intercept")
    return {"velocity_range_m_s": BALL_SPEEDS_M_S[mode]} if mode in BALL_SPEEDS_M_S else {}


def _row(line: dict[str, str]) -> TaskSpec:
    return TaskSpec(
        id=f"{NAMESPACE_90}{line['name']}",
        horizon_steps=int(line["horizon_steps"]),
        memory=cast(MemoryType, line["memory"]),
        instruction_key=f"{NAMESPACE_90}{line['name']}",
        instruction=line["instruction"],
        description=line["instruction"],
        suite="mikasa_vla_90",
        phase_source=cast(PhaseSource, line["phases"]),
        waits_for_choice=line["waits"] == "yes",
        **{**_OF_ALL, **control_fields(line["name"])},
    )


_TEXT = files("vla_eval.tasks.catalogs").joinpath(TABLE).read_text(encoding="utf-8")
MIKASA_VLA_90 = {row.id: row for row in map(_row, csv.DictReader(_TEXT.splitlines(), delimiter=";"))}


def original_tasks(rows: Iterable[TaskSpec]) -> dict[str, TaskSpec]:
    """Return the package's original tasks: those of the paper, of which `rows` are this package's versions.

    Ids, horizons and sentences are the same. Left out are the tasks with a peg: the angle asked for is in
    none of the official observations.
    """
    found = (
        TaskSpec(
            id=f"{NAMESPACE_ORIGINAL}{row.id}",
            horizon_steps=row.horizon_steps,
            memory=row.memory,
            instruction_key=row.instruction_key,
            description=row.description,
            suite="mikasa_official",
            phase_source=_original_phases(row),
            **_OF_ALL,
        )
        for row in rows
        if row.suite == "paper" and not row.id.startswith("Rotate")
    )
    return {row.id: row for row in found}


def _original_phases(row: TaskSpec) -> PhaseSource:
    if row.id.startswith(("Remember", "BunchOfColors")):
        return "cue_and_delay"
    return "cue" if row.id.startswith("ShellGame") else "none"
