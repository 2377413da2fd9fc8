"""All task ids, one row each. Importing it starts no simulator.

Horizons, phases and instructions: the paper, appendix "VLA experiments", and `docs/tasks.md`. Other installed
packages add rows by entry points of the group `vla_eval.tasks`, which are loaded on first use.
"""

import functools
import math
import re
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import get_args

from vla_eval.base_tasks.row import NAMESPACE as NAMESPACE_BASE
from vla_eval.errors import PluginError, TaskArgumentError, UnknownNameError, unknown_name
from vla_eval.tasks.catalogs.base_catalog import MIKASA_BASE
from vla_eval.tasks.catalogs.official_catalog import (
    MIKASA_VLA_90,
    NAMESPACE_90,
    NAMESPACE_ORIGINAL,
    original_tasks,
)
from vla_eval.tasks.catalogs.real_twin_catalog import REAL_TWIN
from vla_eval.tasks.catalogs.sequence_catalog import SEQUENCE_TASKS
from vla_eval.tasks.catalogs.spatial_catalog import SPATIAL_TASKS
from vla_eval.tasks.families import FAMILY_TABLE, make_families
from vla_eval.tasks.spec import Suite, TaskSpec

TASK_GROUP = "vla_eval.tasks"
TASK_ID = re.compile(r"([A-Za-z]\w*/)?[A-Za-z]\w*(-\w+)*-v\d+", re.ASCII)
VERSION = re.compile(r"(-VLA)?-v\d+", re.ASCII)
N_MUGS = 3


def _remember(
    family: str, number: str, kwargs: dict[str, int], what: str, *, suite: Suite = "paper"
) -> TaskSpec:
    return TaskSpec(
        id=f"{family}{number}-v0",
        entry_point=f"vla_eval.tasks.remember:{family}Env",
        kwargs=kwargs,
        horizon_steps=60,
        memory="object",
        instruction_key=family,
        description=f"An item is shown, the table is empty for a while, then {what}",
        success="The tool centre point is within 5 cm of the right item and the arm is at rest.",
        oracle="vla_eval.oracles.hover:CUBES",
        oracle_sees="poses of all items and which one is right; moves once the choice has appeared",
        candidates="items",
        candidate_counts=kwargs,
        chance_success=1 / math.prod(kwargs.values()),
        suite=suite,
    )


_ITEMS = {
    "RememberColor": "cubes of different colours lie there: reach the one that has the colour shown.",
    "RememberShape": "blue items of different shapes lie there: reach the one that has the shape shown.",
}
_REMEMBER = (
    *(
        _remember(family, f"{n}", {"n_items": n}, f"{n} {what}")
        for family, what in _ITEMS.items()
        for n in (3, 5, 9)
    ),
    *(
        _remember(
            "RememberShapeAndColor",
            f"{shapes}x{colors}",
            {"n_shapes": shapes, "n_colors": colors},
            f"items of {shapes} shapes in {colors} colours lie there: reach the one that was shown.",
        )
        for shapes, colors in ((3, 2), (3, 3), (5, 3))
    ),
)
_OBJECTS = tuple(
    _remember(
        "RememberObject",
        f"{n}",
        {"n_items": n},
        f"{n} everyday things lie there: reach the one that was shown.",
        suite="objects",
    )
    for n in (3, 5, 9)
)


def _shell_game(mode: str, *, asks: str, success: str, oracle: str, turns_wrist: bool = False) -> TaskSpec:
    module = "shell_game" if mode == "Touch" else "shell_game_moves"
    return TaskSpec(
        id=f"ShellGame{mode}-v0",
        entry_point=f"vla_eval.tasks.{module}:ShellGame{mode}Env",
        horizon_steps=90,
        memory="object",
        instruction_key=f"ShellGame{mode}",
        description=f"A ball lies at one of three places, then a mug stands on each of them: {asks}",
        success=success,
        oracle=oracle,
        turns_wrist=turns_wrist,
        oracle_sees="poses of all mugs and which one is right; moves once the mugs have appeared",
        candidates="mugs",
        candidate_counts={"n_mugs": N_MUGS},
        cue_marks_place=True,
        chance_success=1 / N_MUGS,
    )


_SHELL_GAME = (
    _shell_game(
        "Touch",
        asks="reach the mug that hides the ball.",
        success="The tool centre point is within 8 cm of the right mug and the arm is at rest.",
        oracle="vla_eval.oracles.hover:MUGS",
    ),
    _shell_game(
        "Push",
        asks="push the mug that hides the ball forwards.",
        success="The right mug is within 8 cm of a point 10 cm ahead of the ball and the arm is at rest.",
        oracle="vla_eval.oracles.push:MUGS",
    ),
    _shell_game(
        "Pick",
        asks="lift the mug that hides the ball.",
        success="The right mug's centre has risen by 10 cm and the arm is at rest.",
        oracle="vla_eval.oracles.pick:MUGS",
        turns_wrist=True,
    ),
)

TASKS: dict[str, TaskSpec] = {
    spec.id: spec for spec in (*_REMEMBER, *SEQUENCE_TASKS, *_SHELL_GAME, *SPATIAL_TASKS, *_OBJECTS)
}


FAMILIES = make_families(TASKS)
"""Family id -> its row: tasks that are specified by arguments, such as `RememberColor` with `n_items=4`."""

OFFICIAL_TASKS: dict[str, TaskSpec] = {**MIKASA_VLA_90, **original_tasks(TASKS.values())}
"""The tasks of the official package, which run only where it is installed."""

_ELSEWHERE = {**OFFICIAL_TASKS, **MIKASA_BASE, **REAL_TWIN}

SUITES: dict[Suite, dict[str, TaskSpec]] = {
    suite: {spec.id: spec for spec in (*TASKS.values(), *_ELSEWHERE.values()) if spec.suite == suite}
    for suite in get_args(Suite)
}


@functools.cache
def installed_tasks() -> dict[str, TaskSpec]:
    """Return the tasks that other installed packages add, by their ids.

    Raises:
        PluginError: one of them cannot be loaded, or is not a task that can be added.
    """
    found: dict[str, TaskSpec] = {}
    for point in entry_points(group=TASK_GROUP):
        for row in _rows_of(point):
            if row.id in found or _own(row.id) is not None:
                raise _unusable(point, f"the task id '{row.id}' is taken", "Give its task another id")
            found[row.id] = row
    return found


def _rows_of(point: EntryPoint) -> Sequence[TaskSpec]:
    try:
        found = point.load()
    except Exception as exc:  # whatever the code of another package raises
        raise _unusable(point, f"{type(exc).__name__}: {exc}", "Update or uninstall it") from exc
    rows = found if isinstance(found, list | tuple) else [found]
    for row in rows:
        if not isinstance(row, TaskSpec) or row.suite != "paper" or not TASK_ID.fullmatch(row.id):
            expected = "a TaskSpec of the suite 'paper' with an id such as MyTask-v0, or a list of them"
            raise _unusable(point, f"found {row!r:.200}", f"Let {point.value} be {expected}")
    return rows


def _unusable(point: EntryPoint, problem: str, advice: str) -> PluginError:
    package = point.dist.name if point.dist else "unknown"
    return PluginError(
        f"the installed package '{package}' adds tasks by {point.value} (entry point '{point.name}' of the "
        f"group {TASK_GROUP}), which cannot be used: {problem}. {advice}."
    )


def _own(name: str) -> TaskSpec | None:
    return TASKS.get(name) or FAMILIES.get(name) or _ELSEWHERE.get(name)


def find_task(task_id: str) -> TaskSpec | None:
    """Return the row of a task or a family, or None if there is none of this id.

    Raises:
        PluginError: it is not one of ours, and what other packages add cannot be loaded.
    """
    name = task_id.removeprefix("vla_eval/")
    return _own(name) or installed_tasks().get(name) or _own(with_version(name))


_FAMILY_OF = {TASKS[family.row].instruction_key: family.id for family in FAMILY_TABLE}


def family_of(spec: TaskSpec) -> str:
    """Return the id of the family that a task belongs to; its own id if it belongs to none."""
    return _FAMILY_OF.get(spec.instruction_key, spec.id) if spec.id in (*TASKS, *FAMILIES) else spec.id


def with_version(task_id: str) -> str:
    """Return `RememberColor3-v0` for `RememberColor3` if that is its only version; else the id as it is."""
    versions = _versions(task_id)
    return versions[0] if len(versions) == 1 else task_id


def _versions(task_id: str) -> list[str]:
    """Return the ids that are this one with a version, if it is none itself."""
    name = task_id.removeprefix("vla_eval/")
    if _own(name) is not None:
        return []
    rows = {**TASKS, **_ELSEWHERE}
    return [known for known in rows if VERSION.fullmatch(known.removeprefix(name)) and known.startswith(name)]


def task_spec(task_id: str) -> TaskSpec:
    """Return the row of a task or a family.

    Args:
        task_id: `RememberColor3-v0` or `RememberColor`, with or without the `vla_eval/` namespace; of the
            official package `mikasa_vla/RememberColor3-VLA-v0` or `mikasa_official/RememberColor3-v0`.

    Raises:
        UnknownNameError: there is no such task; the message suggests the closest one.
        PluginError: see `find_task`.
    """
    spec = find_task(task_id)
    if spec is None:
        known = [*TASKS, *FAMILIES, *installed_tasks()]
        if task_id.startswith((NAMESPACE_90, NAMESPACE_ORIGINAL)):
            known = list(OFFICIAL_TASKS)
        if task_id.startswith(NAMESPACE_BASE):
            known = list(MIKASA_BASE)
        if versions := _versions(task_id):
            raise UnknownNameError(f"there are several tasks '{task_id}': {', '.join(versions)}. Name one.")
        raise unknown_name("task", task_id.removeprefix("vla_eval/"), known)
    return spec


def robot_task(task_id: str, *, does: str) -> TaskSpec:
    """Return the row of a task with a robot, for what `does` something that needs one; else as `task_spec`.

    Raises:
        TaskArgumentError: it is a task of MIKASA-Base.
    """
    spec = task_spec(task_id)
    if spec.is_base:
        raise TaskArgumentError(
            f"{spec.id}: {does} a robot's task, and MIKASA-Base has none. Use one of `mikasa-vla list tasks`."
        )
    return spec
