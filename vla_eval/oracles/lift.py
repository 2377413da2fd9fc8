"""Expert for RealTwin: grasp the chosen cube from above and lift it."""

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

HOVER_M = 0.10
GRASP_M = 0.02
OVER_M = 0.012
AT_GRASP_M = 0.008
CUBE_WIDTH_M = 0.04
HELD_WIDTH_M = 0.043
NEAR_M = 0.03  # a closed hand this near to the cube's centre holds it
LIFT_TO_M = 0.12  # over the table; higher than any cube has to be
LIFTED_M = 0.08


class LiftExpert:
    """Lifts a cube. Plans from the present state alone."""

    def plan(self, state: PrivilegedState, candidate: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7) that lift a cube, planned from `state` alone."""
        arm, cube_m = model.arm_state(state), state.candidate_positions_m[candidate].copy()
        rows = []
        for _ in range(n_actions):
            held = arm.width_m < HELD_WIDTH_M and float(np.linalg.norm(arm.position_m - cube_m)) < NEAR_M
            translation, gripper = _command(arm, cube_m, held=held)
            rows.append(model.action_row(translation, gripper))
            before = arm.position_m
            arm = model.advance_gripper(
                model.advance(arm, translation), 0.0, gripper, held_width_m=CUBE_WIDTH_M
            )
            cube_m = cube_m + (arm.position_m - before if held else 0.0)
        return np.stack(rows)

    def is_done(self, state: PrivilegedState, candidate: int) -> bool:
        """Whether the cube has been lifted."""
        return bool(state.candidate_positions_m[candidate][2] > LIFTED_M)


def _command(arm: model.ArmState, cube_m: model.Vector, *, held: bool) -> tuple[model.Vector, float]:
    """Return translation and gripper command of a control step."""
    if held:
        return model.towards(np.array([*arm.position_m[:2], LIFT_TO_M]), arm), model.GRIPPER_CLOSED
    over = float(np.linalg.norm((cube_m - arm.position_m)[:2])) < OVER_M
    low = abs(float(arm.position_m[2]) - GRASP_M) < AT_GRASP_M
    if over and low:
        return np.zeros(3), model.GRIPPER_CLOSED
    goal_m = np.array([*cube_m[:2], GRASP_M if over else HOVER_M])
    return model.towards(goal_m, arm), model.GRIPPER_OPEN


CUBES = LiftExpert()
