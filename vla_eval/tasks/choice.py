"""Tasks that end in a choice: one of N candidates is right, and it was shown before.

Knows where candidates may lie, which one is touched first, and when the choice is a success. The family
defines what the candidates are and how the cue is shown.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from mani_skill.utils.structs import Actor
from numpy.typing import NDArray

from vla_eval.core import FloatArray
from vla_eval.task_state import PHASES, PrivilegedState, TaskStatus
from vla_eval.tasks.memory_env import MemoryTableEnv, Wxyz, nearness, poses
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import (
    Flags,
    Indices,
    Steps,
    anywhere,
    length,
    position_of_one,
    positions_of,
)
from vla_eval.tasks.objects.layout import places_from_right
from vla_eval.tasks.objects.limits import Positive, StepCount
from vla_eval.tasks.tensors_out import Info

NO_CHOICE = -1


class ChoiceEnv(MemoryTableEnv):
    """A memory task with candidates; the families define what is shown.

    A candidate counts as touched when, in the response phase, it is the nearest one to the tool centre
    point, within `goal_threshold_m` of it, and the arm is at rest.

    Args:
        goal_threshold_m: maximum distance of the tool centre point.
        strict_choice: the first wrong candidate that is touched ends the episode as a failure.
        show_cue: False: the cue phase passes without showing anything. Everything else is the same for
            the same seed. So a policy that is as good without the cue as with it does not need it.
        cue_after_steps: the cue phase begins with so many steps in which nothing is shown.
    """

    REACH_SCALE_PER_M: float
    touch_height_m = 0.0
    """Height of the point to touch over a candidate's centre."""
    candidates: list[Actor]
    candidate_names: tuple[str, ...] = ()
    """Names of the candidates where the task's id does not say them."""
    in_order = False
    """Whether right candidates, if there are several, must be touched in the order of `right_candidates`."""

    def __init__(
        self,
        *args: Any,
        goal_threshold_m: Positive,
        strict_choice: bool = False,
        show_cue: bool = True,
        cue_after_steps: StepCount = 0,
        **kwargs: Any,
    ) -> None:
        limits.check(Positive, goal_threshold_m=goal_threshold_m)
        limits.check(StepCount, cue_after_steps=cue_after_steps)
        self.goal_threshold_m = goal_threshold_m
        self.strict_choice = strict_choice
        self.show_cue = show_cue
        self.cue_after_steps = cue_after_steps
        super().__init__(*args, **kwargs)

    def _load_scene(self, options: dict[str, Any]) -> None:
        super()._load_scene(options)
        n_candidates = len(self.candidates)
        self._target: Indices = np.zeros(self.num_envs, dtype=np.int64)
        self._slots: FloatArray = np.zeros((self.num_envs, n_candidates, 3), dtype=np.float32)
        self._places: list[tuple[int, ...]] = [()] * self.num_envs
        self._first_choice = np.full_like(self._target, NO_CHOICE)
        # 1 for the candidate that was touched first, 2 for the second …, 0 for those never touched.
        self._touch_rank: Indices = np.zeros((self.num_envs, n_candidates), dtype=np.int64)
        self._touched_wrongly: Flags = np.zeros_like(self._touch_rank, dtype=np.bool_)
        self._rows = np.arange(self.num_envs)

    def _on_episode_start(self, mask: Flags) -> None:
        self._first_choice[mask] = NO_CHOICE
        self._touch_rank[mask] = 0
        self._touched_wrongly[mask] = False
        for env in np.flatnonzero(mask):
            self._places[env] = places_from_right(self._slots[env, :, :2].astype(np.float64))

    def total_cue_steps(self, cue_steps: int) -> int:
        """Return the length of the cue phase, the steps before the cue included."""
        return self.cue_after_steps + super().total_cue_steps(cue_steps)

    def candidate_positions_m(self) -> FloatArray:
        """Return (B, N, 3): where the candidates are now, parked ones included, world frame."""
        return positions_of(self.candidates)

    def final_positions_m(self) -> FloatArray:
        """Return (B, N, 3): where the candidates are, or will be when the response phase begins."""
        revealed = self.response_begun()[:, None, None]
        return np.where(revealed, self.candidate_positions_m(), self._slots)

    def touch_points_m(self) -> FloatArray:
        """Return (B, N, 3): the points that the tool centre point must come near, world frame."""
        return self._raised(self.candidate_positions_m())

    def target_point_m(self) -> FloatArray:
        """Return (B, 3): the one of `touch_points_m` that is right now."""
        return self._raised(position_of_one(self.candidates, self.target_index()))

    def _raised(self, points_m: FloatArray) -> FloatArray:
        if self.touch_height_m:
            points_m[..., 2] += self.touch_height_m
        return points_m

    def target_index(self) -> Indices:
        """Return (B,) the index of the candidate that is right now."""
        return self._target

    def right_candidates(self, env: int) -> tuple[int, ...]:
        """Return the right candidates of one environment's episode, in the order shown."""
        return (int(self._target[env]),)

    def shown_candidates(self, env: int) -> tuple[int, ...]:
        """Return the right candidates of one environment's episode whose cue is in view now."""
        step = int(self.step_count()[env])
        in_view = self.cue_after_steps <= step < int(self._cue_end_step[env])
        return self.right_candidates(env) if in_view and self.show_cue else ()

    def touched_candidates(self, env: int) -> tuple[int, ...]:
        """Return the candidates touched so far in one environment's episode, in the order of first touch."""
        ranks = self._touch_rank[env].tolist()
        return tuple(sorted((i for i, rank in enumerate(ranks) if rank), key=lambda i: ranks[i]))

    def chance_success(self) -> float:
        """Return the success rate of a perfect arm that ignores the cue."""
        return 1 / len(self.candidates)

    def target_distance_m(self) -> FloatArray:
        """Return (B,) the distance from the tool centre point to the point to touch."""
        return length(self.target_point_m() - self.tcp_position_m())

    def _of_target(self, per_candidate: NDArray[Any]) -> NDArray[Any]:
        found: NDArray[Any] = per_candidate[self._rows, self.target_index()]
        return found

    def _is_wrong(self, candidate: Indices) -> Flags:
        """Return (B,) whether it would be wrong to touch these candidates, (B,) indices, now."""
        wrong: Flags = candidate != self._target
        return wrong

    def _update_latches(self, step: Steps) -> None:
        begun = step >= self._response_step
        if not anywhere(begun):
            return
        distances = length(self.touch_points_m() - self.tcp_position_m()[:, None, :])
        nearest = distances.argmin(axis=1)
        near = begun & (distances[self._rows, nearest] <= self.goal_threshold_m)
        self._latch_touch(near & self.is_static() if anywhere(near) else near, nearest)

    def _latch_touch(self, touches: Flags, candidate: Indices) -> None:
        """Record, where `touches` (B,) holds, that these candidates, (B,) indices, are touched."""
        if not anywhere(touches):
            return
        first = touches & (self._first_choice == NO_CHOICE)
        self._first_choice[first] = candidate[first]
        first_time = touches & (self._touch_rank[self._rows, candidate] == 0)
        wrong = first_time & self._is_wrong(candidate)
        rank = (self._touch_rank > 0).sum(axis=1) + 1
        self._touch_rank[self._rows, candidate] += rank * first_time
        self._touched_wrongly[self._rows, candidate] |= wrong

    def is_placed(self, reach_m: FloatArray) -> Flags:
        """Return (B,) bool: the success rule holds, except that the arm may still move.

        `reach_m`: (B,) the distance of the tool centre point from the point to touch.
        """
        return reach_m <= self.goal_threshold_m

    def evaluate(self) -> Info:
        """Read success, failure and choices; changes nothing."""
        reach_m, static = self.target_distance_m(), self.is_static()
        placed = self.is_placed(reach_m)
        success = self.gated(placed & static)
        n_wrong = self._touched_wrongly.sum(axis=1)
        lost = (n_wrong > 0) if self.strict_choice else np.zeros(self.num_envs, dtype=np.bool_)
        return {
            "success": success & ~lost,
            "fail": lost,
            "is_obj_placed": placed,
            "is_robot_static": static,
            "target_distance_m": reach_m,
            "first_choice": self._first_choice.copy(),
            "n_wrong_choices": n_wrong,
        }

    def extra_info(self) -> Info:
        """Return the way from the tool centre point to the point to touch, as the official code calls it."""
        return {"obj_to_goal_pos": self.target_point_m() - self.tcp_position_m()}

    def status(self, info: Info, env: int) -> TaskStatus:
        """Return the status, with what was chosen and what is right."""
        right = self.right_candidates(env)
        return TaskStatus(
            phase=PHASES[int(info["phase"][env])],
            success=bool(info["success"][env]),
            fail=bool(info["fail"][env]),
            n_candidates=len(self.candidates),
            n_wrong_choices=int(info["n_wrong_choices"][env]),
            right_first_choices=right[:1] if self.in_order else right,
            chance_success=self.chance_success(),
            candidate_names=self.candidate_names,
            candidate_places=self._places[env],
            right_candidates=right,
            touched_candidates=self.touched_candidates(env),
        )

    def true_state(self, info: Info, env: int) -> PrivilegedState:
        """Return the true state, with the candidates and which are right."""
        return replace(
            super().true_state(info, env),
            candidate_positions_m=self.final_positions_m()[env].astype(np.float64),
            right_candidates=self.right_candidates(env),
            shown_candidates=self.shown_candidates(env),
            in_order=self.in_order,
            touched_candidates=self.touched_candidates(env),
        )

    def oracle_info(self) -> NDArray[np.uint8]:
        """Return (B,): the index of the right candidate."""
        return self._target.astype(np.uint8)

    def reward_terms(self, info: Info) -> Info:
        """Reach the right candidate, slow down there, stand still there (`docs/tasks.md`, rewards)."""
        placed = info["is_obj_placed"]
        return {
            "reaching": nearness(self.REACH_SCALE_PER_M, info["target_distance_m"]),
            "slowing": self.SLOWING_WEIGHT * nearness(5.0, self.arm_speed()) * (placed | self.SLOWS_ANYWHERE),
            "resting": self.RESTING_WEIGHT * (info["is_robot_static"] & placed),
        }

    SLOWING_WEIGHT = 1.0
    RESTING_WEIGHT = 1.0
    SLOWS_ANYWHERE = False
    """Whether slowing down is rewarded also away from the right candidate."""

    def reveal(self, mask: Flags, orientation_wxyz: FloatArray | Wxyz) -> None:
        """Move all candidates to their slots where the mask holds; orientation is (4,) or (B, 4)."""
        if not anywhere(mask):
            return
        for index, actor in enumerate(self.candidates):
            self.move(actor, mask, poses(self._slots[:, index], orientation_wxyz))
