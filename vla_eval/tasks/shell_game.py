"""The shell game: a ball is shown at one of three places, then mugs stand there; find the ball's mug.

Touching it is `ShellGameTouchEnv`; pushing and picking it are in `shell_game_moves`.
"""

import math
from typing import Any, Literal

import numpy as np
import sapien
from mani_skill.utils.building import actors

from vla_eval.core import FloatArray
from vla_eval.errors import TaskArgumentError
from vla_eval.seeding import Stream
from vla_eval.tasks.choice import ChoiceEnv
from vla_eval.tasks.interface import StepRange
from vla_eval.tasks.memory_env import CueSize, Place, Wxyz, poses
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects import mug as mugs
from vla_eval.tasks.objects.bodies import Flags, Steps, anywhere, pose_of, position_of_one
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.layout import LAYOUT_HALF_RANGE_M, MUG_SPACING_M
from vla_eval.tasks.objects.limits import Positive
from vla_eval.tasks.tensors_out import Info

N_MUGS = 3
BALL_RADIUS_M = 0.02
MUG_REST_Z_M = mugs.HEIGHT_M / 2  # the official 0.04 would sink the mug 0.5 mm into the table
_NORM = math.sqrt(1.25)
UPSIDE_DOWN_WXYZ = (0.0, 1 / _NORM, 0.5 / _NORM, 0.0)  # official (0, 1, 0.5, 0), made a unit quaternion


class ShellGameEnv(ChoiceEnv):
    """Find the mug that stands over the ball; the families define what to do with it.

    Description: a red ball lies at one of three places 20 cm apart (cue), then an upside-down mug
    stands on each of them, one over the ball (response, without a delay).

    Starting state: centre of the row uniform in ±10 cm; the ball's place uniform.

    Episode end: 90 control steps; success and failure are reported but end nothing by themselves.

    Arguments: `mug` (`primitive`, or `ycb` if installed), and those of `ChoiceEnv`, `MemoryTableEnv`.

    Chance level: 1/3 for a perfect arm that ignores the cue.
    """

    FAMILY = 2
    HUMAN_CAMERA_EYE = (0.6, 0.7, 0.6)
    HUMAN_CAMERA_TARGET = (0.0, 0.0, 0.15)

    def __init__(
        self,
        *args: Any,
        delay_steps: StepRange = 0,
        mug: Literal["primitive", "ycb"] = "primitive",
        **kwargs: Any,
    ) -> None:
        if mug not in ("primitive", "ycb"):
            raise TaskArgumentError(f"mug={mug!r}: expected 'primitive' or 'ycb'.")
        self.mug = mug
        super().__init__(*args, delay_steps=delay_steps, **kwargs)

    def _load_items(self) -> None:
        self.candidates = []
        make_builder = mugs.ycb_mug_builder if self.mug == "ycb" else mugs.primitive_mug_builder
        for name in ("mug_left", "mug_center", "mug_right"):
            builder = make_builder(self.scene)
            builder.initial_pose = self._mug_parking_pose(name)
            self.candidates.append(builder.build(name=name))
        # Without collision shape: the ball can neither be pushed out of its mug nor push the mug.
        self.ball = actors.build_sphere(
            self.scene,
            radius=BALL_RADIUS_M,
            color=[1.0, 0.0, 0.0, 1.0],
            name="ball",
            body_type="kinematic",
            add_collision=False,
            initial_pose=sapien.Pose(p=[0, 0, BALL_RADIUS_M]),
        )

    def _mug_parking_pose(self, name: str) -> sapien.Pose:
        pose = self.parking_pose(name, half_height_m=MUG_REST_Z_M)
        return sapien.Pose(p=pose.p, q=list(UPSIDE_DOWN_WXYZ))

    def _mug_orientation_wxyz(self) -> FloatArray | Wxyz:
        """Return the orientation of all mugs when they appear, (4,) or (B, 4)."""
        return UPSIDE_DOWN_WXYZ

    def _sample_episode(self, env: int) -> None:
        drawn = int(self.episode_generator(env, Stream.TARGET).integers(N_MUGS))
        self._target[env] = (drawn + self.swap_cue) % N_MUGS
        layout = self.episode_generator(env, Stream.LAYOUT)
        x, y = layout.uniform(-LAYOUT_HALF_RANGE_M, LAYOUT_HALF_RANGE_M, 2)
        for index in range(N_MUGS):
            self._slots[env, index] = (x, y + (index - 1) * MUG_SPACING_M, MUG_REST_Z_M)

    def used_areas(self) -> tuple[Area, ...]:
        """Return where the ball can lie and mugs can stand, with the hand beside or over them."""
        return used_areas(mug=self.mug, goal_threshold_m=self.goal_threshold_m)

    def cue_places_m(self, env: int) -> list[Place]:
        """Return where the ball is shown."""
        x, y, _ = self._slots[env, int(self._target[env])].tolist()
        return [(x, y, 0.0)]

    def cue_size_m(self) -> CueSize:
        """Return the size of the ball."""
        return CueSize(half_width_m=BALL_RADIUS_M, height_m=2 * BALL_RADIUS_M)

    def n_swaps(self) -> int:
        """Return at how many other places the ball could lie."""
        return limits.n_swaps(n_items=N_MUGS)

    def _on_episode_start(self, mask: Flags) -> None:
        super()._on_episode_start(mask)
        for actor in self.candidates:
            self.move(actor, mask, self._mug_parking_pose(actor.name))
        if self.cue_after_steps == 0:
            self._put_ball_under(self._of_target(self._slots), mask)
        else:
            self.move(self.ball, mask, self.parking_pose("ball", half_height_m=BALL_RADIUS_M))

    def _put_ball_under(self, positions: FloatArray, mask: Flags) -> None:
        resting = positions.copy()
        resting[:, 2] = BALL_RADIUS_M
        self.move(self.ball, mask, poses(resting))

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        choice_begins = mask & (step == self._response_step)
        cue_begins = mask & (step == self.cue_after_steps) & (step > 0) & (step < self._cue_end_step)
        if anywhere(cue_begins):
            self._put_ball_under(self._of_target(self._slots), cue_begins & self.show_cue)
        begun = self._cue_end_step if self.show_cue else np.zeros_like(self._cue_end_step)
        hidden = mask & (step >= begun) & (step < self._response_step)
        self.reveal(choice_begins, self._mug_orientation_wxyz())
        # Between cue and choice the ball is hidden; later it moves with its mug.
        if anywhere(hidden):
            self.move(self.ball, hidden, self.parking_pose("ball", half_height_m=BALL_RADIUS_M))
        covered = mask & (step >= self._response_step)
        if anywhere(covered):
            self._put_ball_under(position_of_one(self.candidates, self._target), covered)
        return anywhere(cue_begins | choice_begins | hidden | covered)

    def _privileged_extra(self) -> Info:
        return {
            "obj_pose": self._of_target(np.stack([pose_of(actor) for actor in self.candidates], axis=1)),
            "ball_pose": pose_of(self.ball),
            "oracle_info": self.oracle_info(),
        }


class ShellGameTouchEnv(ShellGameEnv):
    """ShellGameTouch: reach the mug that stands over the ball; see `ShellGameEnv`.

    Observation space: `state` adds the pose of the right mug 7, of the ball 7, oracle 1.

    Rewards: dense, from the response phase on: reach 1 + slow down 1 + stand still 1; 3 if solved.

    Arguments: `goal_threshold_m`, and those of `ShellGameEnv`.

    Version history: 1, first version.
    """

    MAX_REWARD = 3.0
    REACH_SCALE_PER_M = 5.0

    def __init__(self, *args: Any, goal_threshold_m: Positive = 0.08, **kwargs: Any) -> None:
        super().__init__(*args, goal_threshold_m=goal_threshold_m, **kwargs)

    def reward_terms(self, info: Info) -> Info:
        """As in `ChoiceEnv`, but nothing before the mugs stand there (official code)."""
        begun = self.response_begun()
        return {name: term * begun for name, term in super().reward_terms(info).items()}
