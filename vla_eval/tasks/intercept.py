"""Intercept: a ball rolls by; deflect it so that it passes over the target disc."""

from typing import Any

import numpy as np
import sapien
from mani_skill.utils.building import actors

from vla_eval.core import FloatArray
from vla_eval.tasks.ball import RollingBallEnv
from vla_eval.tasks.memory_env import nearness, poses
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import (
    Body,
    Flags,
    Steps,
    length,
    pose_of,
    position_of,
    resting_body,
    spin_of,
    velocity_of,
)
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.items import Z_UP_WXYZ
from vla_eval.tasks.objects.layout import DISC_Y_M, GOAL_OFFSET_X_M
from vla_eval.tasks.objects.limits import Positive
from vla_eval.tasks.tensors_out import Info

GOAL_Z_M = 0.001
HIT_OFFSET_M = 0.07  # distance of the reward's hit point behind the ball, seen from the goal
HIT_REACHED_M = 0.04


class InterceptEnv(RollingBallEnv):
    """Intercept: deflect the rolling ball so that it passes over the disc.

    Description: a red ball rolls along y past the robot; 20 cm beyond its lane lies a disc.

    Observation space: `state` adds goal 3, ball pose 7, initial velocity 3, linear and angular velocity
    3 + 3, tcp to ball 3, ball to goal 3.

    Rewards: dense: 2 for approaching the hit point behind the ball; once there, 5 for the ball approaching
    the goal; 30 if solved.

    Starting state: x in [-0.35, -0.05], y in [-0.9, -0.65] m; velocity along y by `velocity_range_m_s`.

    Episode end: 90 control steps; success is reported but ends nothing by itself. There are no phases:
    the whole episode is response, and the ball is always visible.

    Arguments: `goal_radius_m`, and those of `RollingBallEnv` and `WithoutCueEnv`.

    Chance level: to be measured (`cue_blind`); there are no candidates. A slow ball sometimes rolls over
    the disc by itself (`docs/tasks.md` says how often).

    Version history: 1, first version.
    """

    MAX_REWARD = 30.0
    FAMILY = 3
    BALL_DROP_M = 0.02

    def __init__(self, *args: Any, goal_radius_m: Positive = 0.1, **kwargs: Any) -> None:
        limits.check(Positive, goal_radius_m=goal_radius_m)
        self.goal_radius_m = goal_radius_m
        super().__init__(*args, **kwargs)

    def _load_items(self) -> None:
        super()._load_items()
        self.goal = actors.build_red_white_target(
            self.scene,
            radius=self.goal_radius_m,
            thickness=1e-5,
            name="goal_region",
            add_collision=False,
            body_type="kinematic",
            initial_pose=sapien.Pose(p=[0, 0, GOAL_Z_M], q=list(Z_UP_WXYZ)),
        )
        self._goal_position: FloatArray = np.zeros((self.num_envs, 3), dtype=np.float32)
        self._hit_point_reached: Flags = np.zeros(self.num_envs, dtype=np.bool_)

    def _sample_goal(self, env: int, layout: np.random.Generator, *, lane_x_m: float) -> None:
        self._goal_position[env] = (lane_x_m + GOAL_OFFSET_X_M, layout.uniform(*DISC_Y_M), GOAL_Z_M)

    def _on_episode_start(self, mask: Flags) -> None:
        self._hit_point_reached[mask] = False
        super()._on_episode_start(mask)
        self.move(self.goal, mask, poses(self._goal_position, Z_UP_WXYZ))

    def _ball_to_goal_m(self) -> FloatArray:
        return position_of(self.goal) - self.ball_position_m()

    def _hit_distance_m(self) -> FloatArray:
        away = -self._ball_to_goal_m()
        hit_point = self.ball_position_m() + HIT_OFFSET_M * (away / length(away)[:, None])
        return length(hit_point - self.tcp_position_m())

    def _update_latches(self, step: Steps) -> None:
        self._hit_point_reached |= self._hit_distance_m() < HIT_REACHED_M

    def evaluate(self) -> Info:
        """Read success: the ball is over the disc at this step; changes nothing."""
        distance = length(self._ball_to_goal_m()[:, :2])
        return {
            "success": distance < self.goal_radius_m,
            "reached_status": self._hit_point_reached.copy(),
            "is_robot_static": self.is_static(),
        }

    def used_areas(self) -> tuple[Area, ...]:
        """Return where the ball can roll and the disc can lie, with the hand behind the ball."""
        return used_areas(ball_radius_m=self.ball_radius_m, goal_radius_m=self.goal_radius_m)

    def moving_bodies(self) -> dict[str, Body]:
        """Return `ball` and `goal`."""
        return {**super().moving_bodies(), "goal": resting_body(position_of(self.goal))}

    def reward_terms(self, info: Info) -> Info:
        """Move behind the ball, then push the ball to the goal."""
        reached = self._hit_point_reached
        to_goal = length(self._ball_to_goal_m()[:, :2])
        return {
            "reaching": 2 * nearness(2.0, self._hit_distance_m()) * ~reached,
            "aiming": 5 * nearness(1.0, to_goal) * reached,
        }

    def _privileged_extra(self) -> Info:
        return {
            "goal_pos": position_of(self.goal),
            "ball_pose": pose_of(self.ball),
            "oracle_info": self.oracle_info(),
            "ball_linear_velocity": velocity_of(self.ball),
            "ball_angular_velocity": spin_of(self.ball),
            "tcp_to_ball_pos": self._tcp_to_ball_m(),
            "ball_to_goal_pos": self._ball_to_goal_m(),
        }
