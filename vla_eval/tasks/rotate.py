"""Rotate: turn a peg by a given angle, relative to its initial orientation."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sapien
import torch

from vla_eval.core import FloatArray
from vla_eval.seeding import Stream
from vla_eval.task_state import TaskStatus
from vla_eval.tasks.memory_env import poses
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import (
    Body,
    Flags,
    length,
    moving_body,
    pose_of,
    position_of,
    resting_body,
    velocity_of,
    wrapped_rad,
    yaw_rad,
)
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.layout import PEG_RANGE_M
from vla_eval.tasks.objects.limits import BodySize, Positive
from vla_eval.tasks.tensors_out import Info
from vla_eval.tasks.without_cue import WithoutCueEnv

PEG_RGBA = (12 / 255, 42 / 255, 160 / 255, 1.0)
LENIENT_REACH_M = 0.1
STRICT_REACH_M = 0.04
OFFICIAL_SIGN_SPLIT = 0.5


class RotateEnv(WithoutCueEnv):
    """Rotate: turn the peg by the target angle; in the strict variant, without moving its centre.

    Description: a blue peg lies on the table in a random orientation. It must be turned about the vertical
    by an angle that is part of each observation. The initial orientation has to be remembered.

    Observation space: `rgb` adds `extra/task_cue`, the target angle, rad, counterclockwise seen from above;
    `state` adds remaining angle 1, peg pose 7.

    Rewards: dense, lenient: 1 for approaching the peg's centre; near it up to 15 for the angle; 5 at the
    angle, 2 at rest there; 25 if solved. Strict: 0.5; near it up to 10 for the position and 35 for
    the angle; 10 and 5; 100 if solved.

    Starting state: centre in ±10 cm, yaw uniform.

    Episode end: 90 control steps; success is reported but ends nothing by itself. There are no phases.

    Arguments: `angle_range_rad` (least, most) of the target angle; `signed` (either direction);
    `official_signs` (only the larger half of the angles positive, the smaller half negative, as in the
    official code); `angle_threshold_rad`; `position_threshold_m` for the centre's x and y, None: any
    position; `tilt_threshold_rad` for the tilt of the peg's top from the vertical, None: not checked;
    `peg_half_length_m`, `peg_half_width_m`; and those of `WithoutCueEnv`.

    Chance level: to be measured (`cue_blind`); there are no candidates.

    Version history: 1, first version.
    """

    FAMILY = 11
    PROMPT_DIMS = ("target_angle",)
    HUMAN_CAMERA_EYE = (0.6, 0.7, 0.6)
    HUMAN_CAMERA_TARGET = (0.0, 0.0, 0.35)

    def __init__(
        self,
        *args: Any,
        angle_range_rad: Sequence[float] = (0.1, math.pi / 2),
        signed: bool = False,
        official_signs: bool = False,
        angle_threshold_rad: Positive = 0.1,
        position_threshold_m: Positive | None = None,
        tilt_threshold_rad: Positive | None = None,
        peg_half_length_m: BodySize = 0.12,
        peg_half_width_m: BodySize = 0.025,
        **kwargs: Any,
    ) -> None:
        limits.check(Positive, angle_threshold_rad=angle_threshold_rad)
        limits.check(BodySize, peg_half_length_m=peg_half_length_m, peg_half_width_m=peg_half_width_m)
        optional = {"position_threshold_m": position_threshold_m, "tilt_threshold_rad": tilt_threshold_rad}
        limits.check(Positive, **{name: limit for name, limit in optional.items() if limit is not None})
        limits.check_together(
            angle_range_rad=angle_range_rad,
            angle_threshold_rad=angle_threshold_rad,
            signed=signed,
            official_signs=official_signs,
        )
        least, most = angle_range_rad
        self.angle_range_rad = (float(least), float(most))
        self.signed, self.official_signs = signed, official_signs
        self.angle_threshold_rad = angle_threshold_rad
        self.position_threshold_m = position_threshold_m
        self.tilt_threshold_rad = tilt_threshold_rad
        self.peg_half_sizes_m = (peg_half_length_m, peg_half_width_m, peg_half_width_m)
        self.MAX_REWARD = 25.0 if position_threshold_m is None else 100.0
        super().__init__(*args, **kwargs)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number, whether angles have signs, and whether the position matters."""
        return (self.FAMILY, int(self.signed), int(self.position_threshold_m is not None))

    def _load_items(self) -> None:
        builder = self.scene.create_actor_builder()
        half_sizes = list(self.peg_half_sizes_m)
        builder.add_box_collision(half_size=half_sizes)
        if self.scene.can_render():
            material = sapien.render.RenderMaterial(base_color=PEG_RGBA)
            builder.add_box_visual(half_size=half_sizes, material=material)
        builder.initial_pose = sapien.Pose(p=[0, 0, half_sizes[2]])
        self.peg = builder.build(name="peg")
        self._first_position: FloatArray = np.zeros((self.num_envs, 3), dtype=np.float32)
        self._first_yaw: FloatArray = np.zeros(self.num_envs, dtype=np.float32)
        self._target_angle = np.zeros_like(self._first_yaw)

    def _sample_episode(self, env: int) -> None:
        layout = self.episode_generator(env, Stream.LAYOUT)
        x, y = layout.uniform(-PEG_RANGE_M, PEG_RANGE_M, 2)
        self._first_position[env] = (x, y, self.peg_half_sizes_m[2])
        self._first_yaw[env] = wrapped_rad(np.array(layout.uniform(0, 2 * math.pi), dtype=np.float32))
        self._target_angle[env] = self._draw_angle_rad(self.episode_generator(env, Stream.TARGET))

    def _draw_angle_rad(self, rng: np.random.Generator) -> float:
        least, most = self.angle_range_rad
        share = rng.uniform()
        by_sign = self.signed and not self.official_signs
        if self.swap_cue and not by_sign:
            share = (share + 0.5) % 1
        angle = least + share * (most - least)
        if not self.signed:
            return angle
        positive = share > OFFICIAL_SIGN_SPLIT if self.official_signs else rng.integers(2) == 1
        if self.swap_cue and by_sign:
            positive = not positive
        return angle if positive else -angle

    def n_swaps(self) -> int:
        """Return 1: the angle could be half of the range away, or have the other sign; 0 if it cannot."""
        return limits.n_swaps(
            angle_range_rad=self.angle_range_rad,
            angle_threshold_rad=self.angle_threshold_rad,
            signed=self.signed,
        )

    def _on_episode_start(self, mask: Flags) -> None:
        half = torch.from_numpy(self._first_yaw / 2)  # torch's cosine: numpy's differs in the last bit
        zero = np.zeros_like(self._first_yaw)
        turned = np.stack((half.cos().numpy(), zero, zero, half.sin().numpy()), axis=1)
        self.move(self.peg, mask, poses(self._first_position, turned))

    def prompt(self) -> FloatArray:
        """Return (B, 1): the angle to turn the peg by, rad, counterclockwise seen from above."""
        return self._target_angle[:, None]

    def used_areas(self) -> tuple[Area, ...]:
        """Return where the peg can lie and turn, with the hand around it."""
        length_m, width_m, _ = self.peg_half_sizes_m
        return used_areas(peg_half_length_m=length_m, peg_half_width_m=width_m)

    def _turned_rad(self) -> FloatArray:
        return wrapped_rad(yaw_rad(pose_of(self.peg)[:, 3:]) - self._first_yaw)

    def _shift_m(self) -> FloatArray:
        shift: FloatArray = np.abs((position_of(self.peg) - self._first_position)[:, :2])
        return shift

    def _is_in_place(self) -> Flags:
        if self.position_threshold_m is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        shift_m = self._shift_m()
        return np.maximum(shift_m[:, 0], shift_m[:, 1]) < self.position_threshold_m

    def _is_level(self) -> Flags:
        if self.tilt_threshold_rad is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        w, x, y, z = pose_of(self.peg)[:, 3:].T
        upwards = 1 - 2 * (x * x + y * y) / (w * w + x * x + y * y + z * z)  # of the peg's top
        level: Flags = upwards > math.cos(self.tilt_threshold_rad)
        return level

    def evaluate(self) -> Info:
        """Read success: turned by the target angle, in place, level, arm at rest; changes nothing."""
        turned, static = self._turned_rad(), self.is_static()
        error = np.abs(wrapped_rad(self._target_angle - turned))
        at_angle = error < self.angle_threshold_rad
        shift = self._shift_m()
        return {
            "success": at_angle & self._is_in_place() & self._is_level() & static,
            "is_robot_static": static,
            "relative_angle": turned,
            "y_angle_error": error,
            "x_pos_error": shift[:, 0],
            "y_pos_error": shift[:, 1],
        }

    def status(self, info: Info, env: int) -> TaskStatus:
        """Return the status, with how far the peg is turned."""
        return replace(super().status(info, env), turned_rad=float(info["relative_angle"][env]))

    def moving_bodies(self) -> dict[str, Body]:
        """Return `peg`, and `goal`: its first position and the target yaw."""
        peg = pose_of(self.peg)
        goal_yaw = wrapped_rad(self._first_yaw + self._target_angle)
        return {
            "peg": moving_body(peg[:, :3], velocity_of(self.peg), yaw_rad(peg[:, 3:])),
            "goal": resting_body(self._first_position, goal_yaw),
        }

    def oracle_info(self) -> FloatArray:
        """Return (B,): the remaining angle, rad."""
        return wrapped_rad(self._target_angle - self._turned_rad())

    def reward_terms(self, info: Info) -> Info:
        """Reach the peg's centre, keep the peg in place if that matters, turn it, rest."""
        distance = length(position_of(self.peg) - self.tcp_position_m())
        error = info["y_angle_error"]
        at_angle = error < self.angle_threshold_rad
        resting = at_angle & info["is_robot_static"]
        if self.position_threshold_m is None:
            return {
                "reaching": np.exp(-5 * distance),
                "turning": 15 * np.exp(-1.5 * error) * (distance < LENIENT_REACH_M),
                "at_angle": 5.0 * at_angle,
                "resting": 2.0 * resting,
            }
        near = distance < STRICT_REACH_M
        near_and_placed = near & self._is_in_place()
        return {
            "reaching": 0.5 * np.exp(-3 * distance),
            "placing": 5 * np.exp(-5 * self._shift_m()).sum(axis=1) * near,
            "turning": 35 * np.exp(-error) * near_and_placed,
            "at_angle": 10.0 * (at_angle & near_and_placed),
            "resting": 5.0 * (resting & near_and_placed),
        }

    def _privileged_extra(self) -> Info:
        return {"oracle_info": self.oracle_info(), "peg_pose": pose_of(self.peg)}
