"""Expert for several cubes: move low from one to the next and stop over each until it is touched.

With one action per inference it reads from the state which cubes were touched; with more it predicts touches
with the model of the arm, and returns to a cube that was not touched.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

# Action per metre of distance: a third of the distance per step. A higher gain is a little faster with one
# action per inference, but the arm oscillates, and the model then predicts touches badly.
GAIN_PER_M = 9.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LowFlight:
    """Touches one cube after another."""

    above_top_m: float  # height over a cube's top at which the tool centre point moves and rests
    near_m: float  # the model predicts a touch within this distance of the resting point …
    slow_m_per_step: float  # … at no more than this speed

    def plan_visits(
        self, state: PrivilegedState, wanted: Sequence[int], n_actions: int, *, in_order: bool
    ) -> NDArray[np.float32]:
        """Return (n_actions, 7) that touch the wanted candidates, `in_order` or the nearest first."""
        goals = {index: self._resting_point(state.candidate_positions_m[index]) for index in wanted}
        arm = model.arm_state(state)
        rows = []
        for _ in range(n_actions):
            index = _next_index(goals, arm.position_m, in_order=in_order)
            goal = arm.position_m if index is None else goals[index]
            translation = np.clip(GAIN_PER_M * (goal - arm.position_m), -1, 1)
            rows.append(model.action_row(translation, model.GRIPPER_OPEN))
            arm = model.advance(arm, translation)
            if index is not None and self._touches(arm, goals[index]):
                del goals[index]
        return np.stack(rows)

    def _resting_point(self, centre: model.Vector) -> model.Vector:
        point = centre.copy()
        point[2] = 2 * centre[2] + self.above_top_m  # a cube on the table is twice as high as its centre
        return point

    def _touches(self, arm: model.ArmState, goal: model.Vector) -> bool:
        near = np.linalg.norm(goal - arm.position_m) <= self.near_m
        return bool(near and np.linalg.norm(arm.step_m) <= self.slow_m_per_step)


def _next_index(goals: dict[int, model.Vector], tcp: model.Vector, *, in_order: bool) -> int | None:
    if not goals:
        return None
    if in_order:
        return next(iter(goals))
    return min(goals, key=lambda index: float(np.linalg.norm(goals[index] - tcp)))


CUBES = LowFlight(above_top_m=0.016, near_m=0.006, slow_m_per_step=0.003)
