"""Expert for ShellGamePick: grasp the chosen mug by its handle and lift it.

A mug is wider than the gripper opens and stands upside down, so only the handle can be grasped. The
fingers go to both sides of it, so the wrist is turned first.
"""

import math

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

HANDLE_RADIUS_M = 0.061  # of the tool centre point from the mug's axis: fingers clear of the wall
GRASP_ABOVE_CENTRE_M = 0.012  # the hand stays above the mug's bottom, which is on top
HOVER_ABOVE_CENTRE_M = 0.12
OVER_M = 0.012
AT_GRASP_M = 0.008
ALIGNED_RAD = 0.10
HANDLE_WIDTH_M = 0.008
HELD_WIDTH_M = 0.014
HOLDING_RADIUS_M = 0.11  # a closed hand within this of the mug's centre holds it, however the mug hangs
OVERSHOOT_M = 0.03  # over the required height


class PickExpert:
    """Lifts a mug by its handle."""

    def plan(self, state: PrivilegedState, candidate: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7) that lift a mug, planned from `state` alone."""
        mug, goal = state.bodies[f"mug_{candidate}"], state.bodies[f"goal_{candidate}"]
        mug_m, arm = mug.position_m, model.arm_state(state)
        rows = []
        for _ in range(n_actions):
            near = float(np.linalg.norm(arm.position_m - mug_m)) < HOLDING_RADIUS_M
            held = near and arm.width_m < HELD_WIDTH_M
            if held:
                lift = np.array([0.0, 0.0, goal.position_m[2] + OVERSHOOT_M - mug_m[2]])
                translation, turn, gripper = (
                    model.towards(arm.position_m + lift, arm),
                    0.0,
                    model.GRIPPER_CLOSED,
                )
            else:
                translation, turn, gripper = _to_handle(mug_m, mug.yaw_rad, arm)
            rows.append(model.action_row(translation, gripper, turn))
            before = arm.position_m
            arm = model.advance_gripper(
                model.advance(arm, translation), turn, gripper, held_width_m=HANDLE_WIDTH_M
            )
            if held:
                mug_m = mug_m + arm.position_m - before
        return np.stack(rows)

    def is_done(self, state: PrivilegedState, candidate: int) -> bool:
        """Whether the mug has been lifted."""
        mug, goal = state.bodies[f"mug_{candidate}"], state.bodies[f"goal_{candidate}"]
        return bool(mug.position_m[2] > goal.position_m[2])


def _to_handle(
    mug_m: model.Vector, mug_yaw_rad: float, arm: model.ArmState
) -> tuple[model.Vector, float, float]:
    """Return translation, turn and gripper command that bring the fingers around the handle, then close."""
    direction = np.array([math.cos(mug_yaw_rad), math.sin(mug_yaw_rad), 0.0])
    handle_m = mug_m + HANDLE_RADIUS_M * direction
    yaw_rad = arm.yaw_rad + model.wrapped_rad(mug_yaw_rad - arm.yaw_rad, math.pi)
    over = float(np.linalg.norm((handle_m - arm.position_m)[:2])) < OVER_M
    aligned = abs(yaw_rad - arm.yaw_rad) < ALIGNED_RAD
    low_z = float(mug_m[2]) + GRASP_ABOVE_CENTRE_M
    handle_m[2] = low_z if over and aligned else float(mug_m[2]) + HOVER_ABOVE_CENTRE_M
    around = over and aligned and abs(float(arm.position_m[2]) - low_z) < AT_GRASP_M
    gripper = model.GRIPPER_CLOSED if around else model.GRIPPER_OPEN
    return model.towards(handle_m, arm), model.turn_towards(yaw_rad, arm), gripper


MUGS = PickExpert()
