"""Intercept: a ball rolls by; deflect it so that it passes over the target disc."""

import math
from collections.abc import Sequence
from typing import Any

import sapien
import torch
from mani_skill.utils.building import actors
from mani_skill.utils.structs import Pose

from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.memory_env import MemoryTableEnv, nearness
from vla_eval.tasks.streams import Stream

BALL_RADIUS_M = 0.02
BALL_START_Z_M = 0.04
SPAWN_X_M = (-0.35, -0.05)
SPAWN_Y_M = (-0.9, -0.65)
SIDE_VELOCITY_M_S = (0.0, 0.05)
GOAL_OFFSET_X_M = 0.2
GOAL_Y_M = (-0.2, 0.2)
GOAL_Z_M = 0.001
HIT_OFFSET_M = 0.07  # the reward's hit point lies so far behind the ball, seen from the goal
HIT_REACHED_M = 0.04
UPWARDS_WXYZ = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # ManiSkill's disc faces x; turn it up


class InterceptEnv(MemoryTableEnv):
    """Intercept: deflect the rolling ball so that it passes over the disc.

    Description: a red ball rolls along y past the robot; 20 cm beyond its lane lies a disc.

    Action space: ManiSkill's, by `control_mode`; the harness uses `pd_ee_delta_pose`.

    Observation space: ManiSkill's `rgb` (`agent/qpos`, `agent/qvel`, `extra/tcp_pose`, two cameras) or
    `state` (besides: goal 3, ball pose 7, initial velocity 3, linear and angular velocity 3 + 3,
    tcp to ball 3, ball to goal 3).

    Rewards: dense: 2 for nearing the hit point behind the ball; once there, 5 for the ball nearing the
    goal; 30 where solved.

    Starting state: x in [-0.35, -0.05], y in [-0.9, -0.65] m; velocity along y by `velocity_range_m_s`.

    Episode end: 90 control steps; success is reported but ends nothing by itself. There are no phases:
    the whole episode is response, the ball is always to be seen.

    Arguments: `velocity_range_m_s` (least, most), `goal_radius_m`, and those of `MemoryTableEnv`.

    Chance level: to be measured (`cue_blind`); there are no candidates.

    Version history: 1, first version.
    """

    MAX_REWARD = 30.0
    FAMILY = 3

    def __init__(
        self,
        *args: Any,
        velocity_range_m_s: Sequence[float] = (0.5, 0.75),
        goal_radius_m: float = 0.1,
        **kwargs: Any,
    ) -> None:
        """Check the ranges and build the scene."""
        pair = tuple(float(v) for v in velocity_range_m_s)
        if len(pair) != 2 or not 0 < pair[0] <= pair[1]:
            raise TaskArgumentError(
                f"velocity_range_m_s={velocity_range_m_s!r}: expected (least, most) with 0 < least ≤ most."
            )
        if not goal_radius_m > 0:
            raise TaskArgumentError(f"goal_radius_m={goal_radius_m}: expected > 0.")
        for name in ("cue_steps", "delay_steps"):
            if name in kwargs:
                raise TaskArgumentError(f"{name}: this task has no phases, the ball is always to be seen.")
        self.velocity_range_m_s = pair
        self.goal_radius_m = goal_radius_m
        super().__init__(*args, cue_steps=0, delay_steps=0, **kwargs)

    def _load_items(self) -> None:
        self.ball = actors.build_sphere(
            self.scene,
            radius=BALL_RADIUS_M,
            color=[1.0, 0.0, 0.0, 1.0],
            name="ball",
            initial_pose=sapien.Pose(p=[SPAWN_X_M[0], SPAWN_Y_M[0], BALL_START_Z_M]),
        )
        self.goal = actors.build_red_white_target(
            self.scene,
            radius=self.goal_radius_m,
            thickness=1e-5,
            name="goal_region",
            add_collision=False,
            body_type="kinematic",
            initial_pose=sapien.Pose(p=[0, 0, GOAL_Z_M], q=list(UPWARDS_WXYZ)),
        )
        self._start = torch.zeros(self.num_envs, 3, device=self.device)
        self._initial_velocity = torch.zeros(self.num_envs, 3, device=self.device)
        self._goal_position = torch.zeros(self.num_envs, 3, device=self.device)
        self._hit_point_reached = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def _sample_episode(self, env: int) -> None:
        layout = self.episode_generator(env, Stream.LAYOUT)
        x, y = layout.uniform(*SPAWN_X_M), layout.uniform(*SPAWN_Y_M)
        goal_y = layout.uniform(*GOAL_Y_M)
        motion = self.episode_generator(env, Stream.MOTION)
        v_x, v_y = motion.uniform(*SIDE_VELOCITY_M_S), motion.uniform(*self.velocity_range_m_s)
        self._start[env] = torch.tensor((x, y, BALL_START_Z_M))
        self._initial_velocity[env] = torch.tensor((v_x, v_y, 0.0))
        self._goal_position[env] = torch.tensor((x + GOAL_OFFSET_X_M, goal_y, GOAL_Z_M))

    def _on_episode_start(self, mask: torch.Tensor) -> None:
        self._hit_point_reached[mask] = False
        self.move(self.ball, mask, Pose.create_from_pq(self._start))
        turned = torch.tensor(UPWARDS_WXYZ, device=self.device).expand(self.num_envs, 4)
        self.move(self.goal, mask, Pose.create_from_pq(self._goal_position, turned))
        with self._only(mask):
            self.ball.set_linear_velocity(self._initial_velocity[mask])

    def _on_phase_edges(self, step: torch.Tensor, mask: torch.Tensor) -> bool:
        return False

    def _ball_to_goal_m(self) -> torch.Tensor:
        offset: torch.Tensor = self.goal.pose.p - self.ball.pose.p
        return offset

    def _hit_distance_m(self) -> torch.Tensor:
        away = -self._ball_to_goal_m()
        unit = away / torch.linalg.norm(away, dim=1, keepdim=True)
        hit_point = self.ball.pose.p + HIT_OFFSET_M * unit
        distance: torch.Tensor = torch.linalg.norm(hit_point - self.tcp_position_m(), dim=1)
        return distance

    def _update_latches(self, step: torch.Tensor) -> None:
        self._hit_point_reached |= self._hit_distance_m() < HIT_REACHED_M

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Read success: the ball is over the disc at this step; changes nothing."""
        distance = torch.linalg.norm(self._ball_to_goal_m()[:, :2], dim=1)
        return {
            "success": distance < self.goal_radius_m,
            "reached_status": self._hit_point_reached.clone(),
            "is_robot_static": self.is_static(),
        }

    def moving_bodies(self) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return position and velocity of `ball` and `goal`."""
        goal = self.goal.pose.p
        return {
            "ball": (self.ball.pose.p, self.ball.linear_velocity),
            "goal": (goal, torch.zeros_like(goal)),
        }

    def oracle_info(self) -> torch.Tensor:
        """Return (B, 3): the ball's initial velocity, m/s, world frame."""
        return self._initial_velocity

    def reward_terms(self, info: dict[str, Any]) -> dict[str, torch.Tensor]:
        """Get behind the ball; from then on, bring the ball to the goal."""
        reached = self._hit_point_reached
        to_goal = torch.linalg.norm(self._ball_to_goal_m()[:, :2], dim=1)
        return {
            "reaching": 2 * nearness(2.0, self._hit_distance_m()) * ~reached,
            "aiming": 5 * nearness(1.0, to_goal) * reached,
        }

    def _privileged_extra(self) -> dict[str, torch.Tensor]:
        ball = self.ball.pose
        return {
            "goal_pos": self.goal.pose.p,
            "ball_pose": ball.raw_pose,
            "oracle_info": self.oracle_info(),
            "ball_linear_velocity": self.ball.linear_velocity,
            "ball_angular_velocity": self.ball.angular_velocity,
            "tcp_to_ball_pos": ball.p - self.tcp_position_m(),
            "ball_to_goal_pos": self._ball_to_goal_m(),
        }
