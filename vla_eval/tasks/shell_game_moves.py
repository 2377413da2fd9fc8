"""ShellGamePush and ShellGamePick: the mug over the ball must be moved, forwards or up.

A mug counts as chosen once it has been moved, in the response phase, by the distance that success needs,
but at most `CHOSEN_M`: a wrong mug that is pushed aside counts, one that is only brushed does not.
"""

import math
from typing import Any

import numpy as np

from vla_eval.core import FloatArray
from vla_eval.tasks.memory_env import Wxyz, nearness
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import (
    Body,
    Flags,
    Steps,
    anywhere,
    length,
    moving_body,
    pose_of,
    position_of_one,
    resting_body,
    velocity_of,
    yaw_rad,
)
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.limits import LiftHeight, Positive
from vla_eval.tasks.shell_game import BALL_RADIUS_M, N_MUGS, ShellGameEnv
from vla_eval.tasks.tensors_out import Info

CHOSEN_M = 0.02
GOAL_ABOVE_BALL_M = 0.025
PUSH_REACH_M = 0.08
PICK_REACH_M = 0.04
# The official quaternions (0, 1, s, 0): s depends on the mug that hides the ball, so the handles reveal it.
# Here all mugs have the last one.
OFFICIAL_TURNS = (2.3, 2.7, 2.5)


def _upside_down_wxyz(turn: float) -> tuple[float, float, float, float]:
    norm = math.hypot(1, turn)
    return (0.0, 1 / norm, turn / norm, 0.0)


class ShellGameMoveEnv(ShellGameEnv):
    """Move the mug that stands over the ball to its goal; see `ShellGameEnv`."""

    MODE: int
    """Number of the mode in random streams. Part of every result: never renumber, only add."""
    goal_offset_m: tuple[float, float, float]
    """The goal relative to the ball's centre; world frame."""
    chosen_m: float
    """The distance by which a mug must have been moved to count as chosen."""
    SLOWING_WEIGHT = 0.2
    RESTING_WEIGHT = 0.2

    def stream_key(self) -> tuple[int, ...]:
        """Return the shell game's number and the mode's: a seed gives different places in each mode."""
        return (self.FAMILY, self.MODE)

    def goal_positions_m(self) -> FloatArray:
        """Return (B, N, 3): the goal of each mug if the ball were under it; world frame."""
        goals = self._slots.copy()
        goals[:, :, 2] = BALL_RADIUS_M
        return goals + np.array(self.goal_offset_m, dtype=np.float32)

    def _target_to_goal_m(self) -> FloatArray:
        return self._of_target(self.goal_positions_m()) - position_of_one(self.candidates, self._target)

    def is_placed(self, reach_m: FloatArray) -> Flags:
        """Return (B,) bool: the right mug is within the threshold of its goal."""
        return length(self._target_to_goal_m()) <= self.goal_threshold_m

    def _update_latches(self, step: Steps) -> None:
        begun = step > self._response_step
        if not anywhere(begun):
            return
        moved_m = length(self.candidate_positions_m() - self._slots)
        # Largest movement first: it was touched first if two pass the limit in the same step.
        order = (-moved_m).argsort(axis=1, kind="stable")
        for index in order.T:
            self._latch_touch(begun & (moved_m[self._rows, index] >= self.chosen_m), index)

    def extra_info(self) -> Info:
        """Return the way of the right mug to its goal."""
        return {"obj_to_goal_pos": self._target_to_goal_m()}

    def moving_bodies(self) -> dict[str, Body]:
        """Return `mug_0` … and `goal_0` …, of all mugs alike, in candidate order."""
        bodies = {}
        goals = self.goal_positions_m()
        for index, actor in enumerate(self.candidates):
            bodies[f"mug_{index}"] = moving_body(
                self.final_positions_m()[:, index], velocity_of(actor), yaw_rad(pose_of(actor)[:, 3:])
            )
            bodies[f"goal_{index}"] = resting_body(goals[:, index])
        return bodies

    def _privileged_extra(self) -> Info:
        return {"goal_pos": self._of_target(self.goal_positions_m()), **super()._privileged_extra()}


class ShellGamePushEnv(ShellGameMoveEnv):
    """ShellGamePush: push the mug that stands over the ball forwards; see `ShellGameEnv`.

    Observation space: `state` adds goal 3, pose of the right mug 7, of the ball 7, oracle 1.

    Rewards: dense, from the response phase on: reach the mug 1, bring it to the goal 2 while the tool
    centre point is within 8 cm of it, slow down 0.2 and stand still 0.2 there; 4 if solved.

    Arguments: `push_distance_m`, distance of the goal ahead of the ball; `goal_threshold_m`, maximum
    distance of the mug's centre from it (with the defaults a push of 2 cm is enough); and those of
    `ShellGameEnv`.

    Version history: 1, first version.
    """

    MAX_REWARD = 4.0
    MODE = 1
    REACH_SCALE_PER_M = 10.0

    def __init__(
        self, *args: Any, push_distance_m: Positive = 0.1, goal_threshold_m: Positive = 0.08, **kwargs: Any
    ) -> None:
        limits.check(Positive, push_distance_m=push_distance_m)
        limits.check_together(goal_threshold_m=goal_threshold_m, push_distance_m=push_distance_m)
        self.push_distance_m = push_distance_m
        self.goal_offset_m = (push_distance_m, 0.0, GOAL_ABOVE_BALL_M)
        self.chosen_m = min(CHOSEN_M, push_distance_m - goal_threshold_m)
        super().__init__(*args, goal_threshold_m=goal_threshold_m, **kwargs)

    def used_areas(self) -> tuple[Area, ...]:
        """Return where mugs can stand and be pushed, with the hand behind them."""
        return used_areas(mug=self.mug, push_distance_m=self.push_distance_m)

    def reward_terms(self, info: Info) -> Info:
        """Reach the right mug and push it, once the mugs stand there."""
        reach_m = info["target_distance_m"]
        to_goal_m = length(self._target_to_goal_m())
        terms = super().reward_terms(info)
        terms["pushing"] = 2 * nearness(5.0, to_goal_m) * (reach_m <= PUSH_REACH_M)
        begun = self.response_begun()
        return {name: term * begun for name, term in terms.items()}


class ShellGamePickEnv(ShellGameMoveEnv):
    """ShellGamePick: lift the mug that stands over the ball; see `ShellGameEnv`.

    Observation space: `state` adds goal 3, pose of the right mug 7, of the ball 7, oracle 1, grasped 1.

    Rewards: dense, from the response phase on: reach the mug 3; with the tool centre point within 4 cm of
    its centre 2, bring it to the goal 30, slow down 5 and stand still 5 there; 75 if solved.

    Arguments: `lift_height_m`, height by which the mug's centre must have risen (the paper's 0.1 m);
    `goal_threshold_m` (0.08: the official rule instead, the mug's centre within this distance of a point
    `lift_height_m` + 2.5 cm over the ball, for which 2.4 cm are enough); `official_mug_yaws` (the handles
    reveal which mug it is, as in the official code); and those of `ShellGameEnv`.

    Version history: 1, first version.
    """

    MAX_REWARD = 75.0
    MODE = 2
    REACH_SCALE_PER_M = 10.0

    def __init__(
        self,
        *args: Any,
        lift_height_m: LiftHeight = 0.1,
        goal_threshold_m: Positive | None = None,
        official_mug_yaws: bool = False,
        **kwargs: Any,
    ) -> None:
        limits.check(LiftHeight, lift_height_m=lift_height_m)
        limits.check_together(goal_threshold_m=goal_threshold_m, lift_height_m=lift_height_m)
        self.lift_height_m = lift_height_m
        self.goal_offset_m = (0.0, 0.0, lift_height_m + GOAL_ABOVE_BALL_M)
        self.chosen_m = min(CHOSEN_M, lift_height_m - (goal_threshold_m or 0.0))
        self.goal_is_a_point = goal_threshold_m is not None
        self.official_mug_yaws = official_mug_yaws
        super().__init__(
            *args, goal_threshold_m=lift_height_m if goal_threshold_m is None else goal_threshold_m, **kwargs
        )

    def used_areas(self) -> tuple[Area, ...]:
        """Return where mugs can stand, with the hand at their handles."""
        return used_areas(mug=self.mug, lift_height_m=self.lift_height_m)

    def is_placed(self, reach_m: FloatArray) -> Flags:
        """Return (B,) bool: the right mug has been lifted high enough."""
        if self.goal_is_a_point:
            return super().is_placed(reach_m)
        risen_m = position_of_one(self.candidates, self._target) - self._of_target(self._slots)
        risen: Flags = self.response_begun() & (risen_m[:, 2] >= self.lift_height_m)
        return risen

    def _mug_orientation_wxyz(self) -> FloatArray | Wxyz:
        quaternions = np.array([_upside_down_wxyz(turn) for turn in OFFICIAL_TURNS], dtype=np.float32)
        # The handles belong to the scene: with `swap_cue` they stay as they were drawn.
        drawn = (self._target - self.swap_cue) % N_MUGS
        return quaternions[drawn] if self.official_mug_yaws else quaternions[-1]

    def _is_grasped(self) -> Flags:
        grasped = np.stack([self.grasps(actor) for actor in self.candidates], axis=1)
        return self._of_target(grasped)

    def extra_info(self) -> Info:
        """Return the way of the right mug to its goal, and whether it is grasped."""
        return {**super().extra_info(), "is_grasped": self._is_grasped()}

    def reward_terms(self, info: Info) -> Info:
        """Reach the right mug and lift it, once the mugs stand there."""
        reach_m = info["target_distance_m"]
        to_goal_m = length(self._target_to_goal_m())
        placed, near = info["is_obj_placed"], reach_m <= PICK_REACH_M
        terms = {
            "reaching": 3 * nearness(self.REACH_SCALE_PER_M, reach_m),
            "lifting": (2 + 30 * nearness(5.0, to_goal_m)) * near,
            "slowing": 5 * nearness(5.0, self.arm_speed()) * (placed & near),
            "resting": 5.0 * (info["is_robot_static"] & placed & near),
        }
        begun = self.response_begun()
        return {name: term * begun for name, term in terms.items()}

    def _privileged_extra(self) -> Info:
        return {**super()._privileged_extra(), "is_grasped": self._is_grasped()[:, None]}
