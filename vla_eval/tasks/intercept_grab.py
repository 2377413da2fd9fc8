"""InterceptGrab: a ball rolls by; catch it with the gripper."""

from typing import Any

import numpy as np

from vla_eval.tasks.ball import RollingBallEnv
from vla_eval.tasks.memory_env import nearness
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import Flags, length, pose_of, spin_of, velocity_of
from vla_eval.tasks.objects.limits import CarryHeight
from vla_eval.tasks.tensors_out import Info

# The ball lies between the fingers: within this in x and in y of the tool centre point,
GRIP_HALF_PLANE_M = 0.04
GRIP_HALF_HEIGHT_M = 0.03  # within this in z,
GRIP_RADIUS_M = 0.04  # within this altogether,
BALL_DIAMETER_WIDTH_M = 0.04  # and the fingers are at least this far apart.
SNUG_M = 0.02
NARROW_WIDTH_M = 0.06
TOUCH_RADIUS_M = 0.025


class InterceptGrabEnv(RollingBallEnv):
    """InterceptGrab: grasp the rolling ball and come to rest with it.

    Description: a red ball rolls along y past the robot, which has to catch it between its fingers.

    Observation space: `state` adds ball pose 7, initial velocity 3, grasped 1, linear and angular velocity
    3 + 3, tcp to ball 3, gripper width 1, velocity of the ball relative to the tcp 3.

    Rewards: dense: 10 for approaching the ball; 10 and up to 135 more while it lies between the fingers; up
    to 30 within 2.5 cm of it; 100 while it is grasped; 300 if solved.

    Starting state: as Intercept; the ball begins on the table.

    Episode end: 90 control steps; success is reported but ends nothing by itself. There are no phases.

    Arguments: `lift_height_m` (0: the ball need not be lifted, as in the official code), and those of
    `RollingBallEnv` and `WithoutCueEnv`.

    Chance level: to be measured (`cue_blind`); there are no candidates.

    Version history: 1, first version.
    """

    MAX_REWARD = 300.0
    FAMILY = 9
    BALL_DROP_M = 0.0

    def __init__(self, *args: Any, lift_height_m: CarryHeight = 0.0, **kwargs: Any) -> None:
        limits.check(CarryHeight, lift_height_m=lift_height_m)
        self.lift_height_m = lift_height_m
        super().__init__(*args, **kwargs)

    def evaluate(self) -> Info:
        """Read success: the ball is grasped, high enough, and the arm at rest; changes nothing."""
        grasped, static = self.grasps(self.ball), self.is_static()
        # The tolerance is for a ball that lies on the table: it sinks in by micrometres.
        lifted = self.ball_position_m()[:, 2] >= self.ball_radius_m + self.lift_height_m - 1e-3
        return {"success": grasped & static & lifted, "is_ball_grasped": grasped, "is_robot_static": static}

    def _in_grip(self) -> Flags:
        offset = np.abs(self._tcp_to_ball_m())
        inside = (offset[:, :2] <= GRIP_HALF_PLANE_M).all(axis=1) & (offset[:, 2] <= GRIP_HALF_HEIGHT_M)
        near = length(offset) <= GRIP_RADIUS_M
        return inside & near & (self.gripper_width_m() >= BALL_DIAMETER_WIDTH_M)

    def reward_terms(self, info: Info) -> Info:
        """Reach the ball, get it between the fingers, close them, hold it."""
        distance = length(self._tcp_to_ball_m())
        width = self.gripper_width_m()
        loose_m = np.maximum(np.abs(width - BALL_DIAMETER_WIDTH_M) - SNUG_M, 0)
        closing = 10 + 90 * np.exp(-5 * loose_m) + 45 * (width <= NARROW_WIDTH_M)
        return {
            "reaching": 10 * nearness(3.0, distance),
            "closing": closing * self._in_grip(),
            "touching": 30 * (1 - distance / 0.06) * (distance <= TOUCH_RADIUS_M),
            "holding": 100.0 * info["is_ball_grasped"],
        }

    def _privileged_extra(self) -> Info:
        velocity_m_s = velocity_of(self.ball)
        return {
            "ball_pose": pose_of(self.ball),
            "oracle_info": self.oracle_info(),
            "is_ball_grasped": self.grasps(self.ball)[:, None],
            "ball_linear_velocity": velocity_m_s,
            "ball_angular_velocity": spin_of(self.ball),
            "tcp_to_ball_pos": self._tcp_to_ball_m(),
            "gripper_width": self.gripper_width_m()[:, None],
            "relative_velocity": velocity_m_s - velocity_of(self.agent.tcp),
        }
