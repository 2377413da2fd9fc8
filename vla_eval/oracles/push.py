"""Expert for ShellGamePush: move behind the chosen mug, down, and forwards until the mug is in its goal."""

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

TRAVEL_M = 0.16  # of the tool centre point over the table: above all mugs, 8.1 cm high
PUSH_HEIGHT_M = 0.055  # the hand passes over the mug's top, the fingers push above its centre
LOW_M = 0.08
BEHIND_M = 0.10  # the arm descends this far behind the mug's centre
CONTACT_M = 0.057  # mug radius plus half a finger: the fingers touch it at this distance
LANE_M = 0.02
DEPTH_IN_GOAL_M = 0.05  # the mug is pushed this close to its goal, a circle of 8 cm


class PushExpert:
    """Pushes a mug forwards, away from the robot, and passes over the others."""

    def plan(self, state: PrivilegedState, candidate: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7) that push a mug, planned from `state` alone."""
        mug_m = state.bodies[f"mug_{candidate}"].position_m
        goal_m = state.bodies[f"goal_{candidate}"].position_m
        end_x_m = float(goal_m[0]) - DEPTH_IN_GOAL_M - CONTACT_M
        return model.follow(
            lambda arm: _goal(mug_m, end_x_m, arm), state, n_actions, gripper=model.GRIPPER_CLOSED
        )

    def is_done(self, state: PrivilegedState, candidate: int) -> bool:
        """Whether the mug is in its goal."""
        mug_m = state.bodies[f"mug_{candidate}"].position_m
        goal_m = state.bodies[f"goal_{candidate}"].position_m
        return bool(goal_m[0] - mug_m[0] < DEPTH_IN_GOAL_M + 0.015)


def _goal(mug_m: model.Vector, end_x_m: float, arm: model.ArmState) -> model.Vector:
    x, y, z = (float(v) for v in arm.position_m)
    behind_x, mug_y = float(mug_m[0]) - BEHIND_M, float(mug_m[1])
    in_lane = abs(y - mug_y) < LANE_M
    if in_lane and z < LOW_M and x > behind_x - LANE_M:
        return np.array([end_x_m, mug_y, PUSH_HEIGHT_M])
    if in_lane and abs(x - behind_x) < LANE_M:
        return np.array([behind_x, mug_y, PUSH_HEIGHT_M])
    if z < LOW_M:  # among the mugs: up first
        return np.array([x, y, TRAVEL_M])
    return np.array([behind_x, mug_y, max(TRAVEL_M, min(z, 0.2))])


MUGS = PushExpert()
