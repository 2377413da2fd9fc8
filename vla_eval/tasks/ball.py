"""A ball that rolls across the table: its start, its speed, its state."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.building import actors

from vla_eval.core import FloatArray
from vla_eval.seeding import Stream
from vla_eval.tasks.memory_env import poses
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import Body, Flags, moving_body, position_of, velocity_of
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.layout import SPAWN_X_M, SPAWN_Y_M
from vla_eval.tasks.objects.limits import BodySize
from vla_eval.tasks.without_cue import WithoutCueEnv

SIDE_VELOCITY_M_S = (0.0, 0.05)


class RollingBallEnv(WithoutCueEnv):
    """A red ball rolls along y past the robot; the families define the goal.

    Args:
        velocity_range_m_s: (least, most) of the initial speed along y; a solid ball keeps 5/7 of it once
            it rolls without slipping.
        ball_radius_m: radius of the ball.
    """

    BALL_DROP_M: float
    """Height of the ball's centre at the start, above its resting height."""

    def __init__(
        self,
        *args: Any,
        velocity_range_m_s: Sequence[float] = (0.5, 0.75),
        ball_radius_m: BodySize = 0.02,
        **kwargs: Any,
    ) -> None:
        limits.check_together(velocity_range_m_s=velocity_range_m_s)
        limits.check(BodySize, ball_radius_m=ball_radius_m)
        least, most = velocity_range_m_s
        self.velocity_range_m_s = (float(least), float(most))
        self.ball_radius_m = ball_radius_m
        super().__init__(*args, **kwargs)

    def _load_items(self) -> None:
        self.ball = actors.build_sphere(
            self.scene,
            radius=self.ball_radius_m,
            color=[1.0, 0.0, 0.0, 1.0],
            name="ball",
            initial_pose=sapien.Pose(p=[SPAWN_X_M[0], SPAWN_Y_M[0], self.ball_radius_m + self.BALL_DROP_M]),
        )
        self._start: FloatArray = np.zeros((self.num_envs, 3), dtype=np.float32)
        self._initial_velocity = np.zeros_like(self._start)

    def _sample_episode(self, env: int) -> None:
        layout = self.episode_generator(env, Stream.LAYOUT)
        z_m = self.ball_radius_m + self.BALL_DROP_M
        start_m = (layout.uniform(*SPAWN_X_M), layout.uniform(*SPAWN_Y_M), z_m)
        self._sample_goal(env, layout, lane_x_m=start_m[0])
        motion = self.episode_generator(env, Stream.MOTION)
        side_m_s = motion.uniform(*SIDE_VELOCITY_M_S)
        velocity_m_s = (side_m_s, self._swapped_m_s(motion.uniform(*self.velocity_range_m_s)), 0.0)
        self._start[env] = start_m
        self._initial_velocity[env] = velocity_m_s

    def n_swaps(self) -> int:
        """Return 1: a speed half of the range away; 0 if there is only one speed."""
        return limits.n_swaps(velocity_range_m_s=self.velocity_range_m_s)

    def _swapped_m_s(self, drawn_m_s: float) -> float:
        """Return the drawn speed, or with `swap_cue` the one that is half of the range away."""
        if not self.swap_cue:
            return drawn_m_s
        least, most = self.velocity_range_m_s
        half = (most - least) / 2
        return drawn_m_s + half if drawn_m_s < least + half else drawn_m_s - half

    def _sample_goal(self, env: int, layout: np.random.Generator, *, lane_x_m: float) -> None:
        """Draw the ball's goal, if it has one, after its start has been drawn."""

    def _on_episode_start(self, mask: Flags) -> None:
        self.move(self.ball, mask, poses(self._start))
        with self._only(mask):
            self.ball.set_linear_velocity(torch.as_tensor(self._initial_velocity[mask], device=self.device))

    def used_areas(self) -> tuple[Area, ...]:
        """Return where the ball can roll, with the hand behind it."""
        return used_areas(ball_radius_m=self.ball_radius_m)

    def moving_bodies(self) -> dict[str, Body]:
        """Return `ball`."""
        return {"ball": moving_body(self.ball_position_m(), velocity_of(self.ball))}

    def oracle_info(self) -> FloatArray:
        """Return (B, 3): the ball's initial velocity, m/s, world frame."""
        return self._initial_velocity

    def ball_position_m(self) -> FloatArray:
        """Return (B, 3): the ball's centre, world frame."""
        return position_of(self.ball)

    def _tcp_to_ball_m(self) -> FloatArray:
        return self.ball_position_m() - self.tcp_position_m()
