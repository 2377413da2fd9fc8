"""Expert for choices by touch: move over the chosen candidate, then down, and rest just above it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

TOUCH_MARGIN = 1.2  # close enough is 1.2 times the height at which the arm comes to rest


@dataclass(frozen=True, slots=True, kw_only=True)
class HoverExpert:
    """Reaches a candidate without touching anything."""

    rest_above_m: float  # height over the candidate's centre where the tool centre point comes to rest
    over_radius_m: float  # the arm descends within this horizontal distance
    travel_above_m: float  # until then it keeps at least this height over the candidate's centre
    descend_to_m: float  # on the way it descends to this height over the table

    def plan(self, state: PrivilegedState, candidate: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7) that move the arm model.towards a candidate, planned from `state` alone."""
        centre = state.candidate_positions_m[candidate]
        return model.follow(
            lambda arm: self._goal(centre, arm.position_m), state, n_actions, gripper=model.GRIPPER_OPEN
        )

    def is_done(self, state: PrivilegedState, candidate: int) -> bool:
        """Whether the arm is close enough to a candidate to touch it, if it rests there."""
        distance_m = np.linalg.norm(state.tcp_position_m - state.candidate_positions_m[candidate])
        return bool(distance_m <= TOUCH_MARGIN * self.rest_above_m)

    def _goal(self, centre: model.Vector, tcp: model.Vector) -> model.Vector:
        goal = centre.copy()
        if np.linalg.norm((centre - tcp)[:2]) < self.over_radius_m:
            goal[2] += self.rest_above_m
        else:
            goal[2] = max(centre[2] + self.travel_above_m, min(tcp[2], self.descend_to_m))
        return goal


CUBES = HoverExpert(rest_above_m=0.040, over_radius_m=0.04, travel_above_m=0.09, descend_to_m=0.12)
MUGS = HoverExpert(rest_above_m=0.066, over_radius_m=0.05, travel_above_m=0.116, descend_to_m=0.17)
