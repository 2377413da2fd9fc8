"""A server's actions as this environment means them. Knows nothing of servers."""

from typing import Any  # Any: what a server sent

import numpy as np
from scipy.spatial.transform import Rotation

from vla_eval.core import FloatArray
from vla_eval.policies.remote.settings import ActionSettings
from vla_eval.specs import ActionSpec

N_DELTA_POSE = 7  # three of position, three of rotation, the gripper
POSITION_UNIT_M = 0.1
ROTATION_UNIT_RAD = -0.1
"""What 1 means in an action of `pd_ee_delta_pose`. ManiSkill multiplies the rotation by its lower bound, so
that its sign is reversed; a turn is then x, y, z Euler angles about the moving axes. Sources, the same in
3.0.1: https://github.com/haosulab/ManiSkill/blob/
1abb221ab12ce09030d75509313a9641645f4354/mani_skill/agents/robots/panda/panda.py,
https://github.com/haosulab/ManiSkill/blob/
628bbe64e2c925d9d543171361a86c4a4965c6e9/mani_skill/agents/controllers/pd_ee_pose.py"""


def as_rows(actions: Any) -> Any:
    """Return a reply's actions as (T, A) float32, if they are numbers; the loop refuses the rest."""
    if isinstance(actions, list):
        try:
            actions = np.array(actions)
        except (ValueError, TypeError):
            return actions
        if actions.dtype.kind in "iu":  # JSON and msgpack write 1.0 as 1
            actions = actions.astype(np.float32)
    if not isinstance(actions, np.ndarray):
        return actions
    rows = actions[None] if actions.ndim == 1 else actions
    if rows.dtype.kind != "f":
        return rows
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused
        return rows.astype(np.float32)


def converted(rows: FloatArray, settings: ActionSettings, spec: ActionSpec) -> FloatArray:
    """Return actions (T, 7) float32, which the settings describe, as this environment means them."""
    made = rows.astype(np.float64)
    if settings.position_unit_m is not None:
        made[:, :3] *= settings.position_unit_m / POSITION_UNIT_M
    if settings.rotation_unit_rad is not None:
        turn_rad = made[:, 3:6] * settings.rotation_unit_rad
        if settings.rotation == "axis_angle":
            turn_rad = Rotation.from_rotvec(turn_rad).as_euler("XYZ")
        made[:, 3:6] = turn_rad / ROTATION_UNIT_RAD
    made[:, -1] = _gripper(made[:, -1], settings) * spec.gripper_open
    return made.astype(np.float32)


def _gripper(values: Any, settings: ActionSettings) -> Any:
    """Return the last numbers with 1 for open and -1 for closed."""
    if settings.gripper == "close_positive":
        return -values
    if settings.gripper == "open_01":
        return 2 * values - 1
    return 1 - 2 * values if settings.gripper == "close_01" else values
