"""Which robot the arguments of a task name, and what its actions then are.

Robots of other installed packages are found by entry points of the group `vla_eval.robots`.
"""

import functools
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points

from vla_eval.control_modes import CONTROL_MODE
from vla_eval.errors import PluginError, TaskArgumentError, unknown_name
from vla_eval.robots.arm import Arm
from vla_eval.robots.rows import PANDA, ROWS
from vla_eval.specs import ActionSpec, EnvSpec

ROBOT, ROBOT_UIDS = "robot", "robot_uids"
"""Names of the argument in `env` that chooses one: ours, and ManiSkill's, whose values keep working."""
ROBOT_GROUP = "vla_eval.robots"


@functools.cache
def robots() -> Mapping[str, Arm]:
    """Return all robots by their names: those that ship, then those of other installed packages.

    Raises:
        PluginError: one of these cannot be loaded, or is not a robot that can be added.
    """
    found = {arm.name: arm for arm in ROWS}
    for point in entry_points(group=ROBOT_GROUP):
        arm = _loaded(point)
        if arm.name in found or set(arm.uids) & _by_uid(found).keys():
            raise _unusable(point, f"its name '{arm.name}' or one of its uids, {arm.uids}, is taken")
        found[arm.name] = arm
    return found


def _loaded(point: EntryPoint) -> Arm:
    try:
        arm = point.load()
    except Exception as exc:  # whatever the code of another package raises
        raise _unusable(point, f"{type(exc).__name__}: {exc}") from exc
    if not isinstance(arm, Arm):
        raise _unusable(point, f"found {arm!r:.200}, expected an `Arm` of vla_eval.robots.arm")
    return arm


def _unusable(point: EntryPoint, problem: str) -> PluginError:
    package = point.dist.name if point.dist else "unknown"
    return PluginError(
        f"the installed package '{package}' adds a robot by {point.value} (entry point '{point.name}' of "
        f"the group {ROBOT_GROUP}), which cannot be used: {problem}. Correct it, update or uninstall it."
    )


def _by_uid(arms: Mapping[str, Arm]) -> dict[str, Arm]:
    return {uid: arm for arm in arms.values() for uid in arm.uids}


def robot_with_uid(uid: str, *, where: str = f"env.{ROBOT_UIDS}") -> Arm:
    """Return the robot that has this name in ManiSkill; `where`: what names it, for the message.

    Raises:
        UnknownNameError: none has.
    """
    known = _by_uid(robots())
    if uid not in known:
        raise unknown_name("robot", uid, known, where=where)
    return known[uid]


def robot_named(name: str, *, where: str = "") -> Arm:
    """Return the robot of this name; `where`: the field in which it stands, for the message.

    Raises:
        UnknownNameError: there is none.
    """
    if name not in robots():
        raise unknown_name("robot", name, robots(), where=where)
    return robots()[name]


def robot_of_spec(env: EnvSpec) -> Arm:
    """Return the robot of an environment; the default one where it names none, as servers of policies."""
    return PANDA if env.robot is None else robot_named(env.robot)


def robot_of(env_kwargs: Mapping[str, object]) -> Arm:
    """Return the robot that the arguments of a task name, or the default.

    Raises:
        UnknownNameError: there is no such robot.
        TaskArgumentError: it is named twice.
    """
    if ROBOT in env_kwargs and ROBOT_UIDS in env_kwargs:
        raise TaskArgumentError(
            f"{ROBOT}={env_kwargs[ROBOT]!r:.80} with {ROBOT_UIDS}={env_kwargs[ROBOT_UIDS]!r:.80}: both name "
            f"the robot. Leave {ROBOT_UIDS} out."
        )
    if ROBOT_UIDS in env_kwargs:
        return robot_with_uid(str(env_kwargs[ROBOT_UIDS]))
    if ROBOT not in env_kwargs:
        return PANDA
    return robot_named(str(env_kwargs[ROBOT]), where=f"env.{ROBOT}")


def naming(env_kwargs: Mapping[str, object]) -> str:
    """Return `robot='fetch'` as the arguments of a task have it, for messages; else the default's name."""
    argument = ROBOT_UIDS if ROBOT_UIDS in env_kwargs else ROBOT
    return f"{argument}={env_kwargs.get(argument, PANDA.name)!r:.80}"


def control_mode_of(env_kwargs: Mapping[str, object]) -> str:
    """Return the mode that the arguments of a task name, or the default of the robot that they name."""
    return str(env_kwargs.get(CONTROL_MODE, next(iter(robot_of(env_kwargs).actions))))


def action_of(env_kwargs: Mapping[str, object]) -> ActionSpec:
    """Return what an action is with these arguments of a task.

    Raises:
        UnknownNameError: no robot has such a control mode, or there is no such robot.
        TaskArgumentError: this robot does not have the control mode.
    """
    arm, mode = robot_of(env_kwargs), control_mode_of(env_kwargs)
    if mode in arm.actions:
        return arm.actions[mode]
    known = dict.fromkeys(mode for one in robots().values() for mode in one.actions)
    if mode not in known:
        raise unknown_name("control mode", mode, known, where=f"env.{CONTROL_MODE}")
    raise TaskArgumentError(
        f"{CONTROL_MODE}={mode!r} with {naming(env_kwargs)}: this arm takes {', '.join(arm.actions)}. "
        "Leave one of the two out."
    )
