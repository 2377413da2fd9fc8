"""TakeItBack: move the cube to the goal, then back to its first position, which is not marked."""

from typing import Any

import numpy as np
import sapien
from mani_skill.utils.building import actors

from vla_eval.core import FloatArray
from vla_eval.seeding import Stream
from vla_eval.tasks.memory_env import nearness, poses
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import (
    Body,
    Flags,
    Steps,
    anywhere,
    length,
    moving_body,
    pose_of,
    position_of,
    resting_body,
    velocity_of,
)
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.items import Z_UP_WXYZ
from vla_eval.tasks.objects.layout import GOAL_X_M, GOAL_Y_M, START_BAND_WIDTH_M, START_BANDS_Y_M, START_X_M
from vla_eval.tasks.objects.limits import BodySize, GoalRadius, Positive
from vla_eval.tasks.tensors_out import Info
from vla_eval.tasks.without_cue import WithoutCueEnv

DISC_Z_M = 0.001
DISC_HALF_THICKNESS_M = 1e-5
PUSH_BEHIND_M = 0.025  # distance of the reward's push point behind the cube, seen from the goal,
PULL_AHEAD_M = 0.03  # and of its pull point ahead of it;
CONTACT_M = 0.01  # the tool centre point is there within this distance.
GREEN_RGBA = (0.0, 1.0, 0.0, 1.0)
RED_RGBA = (194 / 255, 19 / 255, 22 / 255, 1.0)
VIOLET_RGBA = (147 / 255, 0.0, 211 / 255, 1.0)


class TakeItBackEnv(WithoutCueEnv):
    """TakeItBack: move the cube into the goal region, then back to its first position.

    Description: a green cube lies in front of the robot, behind it a red disc. Once the cube has been on
    the disc, the disc turns violet and the cube must go back to its first position, which is not marked.

    Observation space: `state` adds goal 3, cube pose 7, first place 3, goal reached 1.

    Rewards: dense: until the goal is reached, 2 for approaching the point behind the cube, and 5 for the
    cube approaching the goal while the arm is there; then 10 and 15 for the way back; 30 if solved.

    Starting state: cube at x in [-0.05, 0.05], y in one of three bands of 5 cm; goal at x in [0.2, 0.25],
    y in [-0.025, 0.025] m.

    Episode end: 180 control steps; success is reported but ends nothing by itself. There are no phases.

    Arguments: `goal_radius_m` and `return_radius_m`, maximum distance of the cube's centre from the centre
    of the disc and from its first position; `cube_half_size_m`; `latch_goal_color` (off: the disc is violet
    only while the cube is on it, as in the official code on the GPU); and those of `WithoutCueEnv`.

    Chance level: to be measured (`cue_blind`); there are no candidates.

    Version history: 1, first version.
    """

    MAX_REWARD = 30.0
    FAMILY = 10

    def __init__(
        self,
        *args: Any,
        goal_radius_m: GoalRadius = 0.08,
        return_radius_m: Positive = 0.08,
        cube_half_size_m: BodySize = 0.02,
        latch_goal_color: bool = True,
        **kwargs: Any,
    ) -> None:
        limits.check(GoalRadius, goal_radius_m=goal_radius_m)
        limits.check(Positive, return_radius_m=return_radius_m)
        limits.check(BodySize, cube_half_size_m=cube_half_size_m)
        self.goal_radius_m = goal_radius_m
        self.return_radius_m = return_radius_m
        self.cube_half_size_m = cube_half_size_m
        self.latch_goal_color = latch_goal_color
        super().__init__(*args, **kwargs)

    def _load_items(self) -> None:
        half = self.cube_half_size_m
        self.cube = actors.build_cube(
            self.scene,
            half_size=half,
            color=list(GREEN_RGBA),
            name="cube",
            initial_pose=sapien.Pose(p=[0, 0, half]),
        )
        self.red_disc = self._build_disc("goal_region", RED_RGBA)
        self.violet_disc = self._build_disc("changed_goal_region", VIOLET_RGBA)
        self._first_place: FloatArray = np.zeros((self.num_envs, 3), dtype=np.float32)
        self._goal_position = np.zeros_like(self._first_place)
        self._goal_reached: Flags = np.zeros(self.num_envs, dtype=np.bool_)
        self._is_violet: Flags = np.zeros_like(self._goal_reached)

    def _build_disc(self, name: str, rgba: tuple[float, ...]) -> Any:  # an actor; ManiSkill is untyped
        builder = self.scene.create_actor_builder()
        if self.scene.can_render():
            material = sapien.render.RenderMaterial(base_color=rgba)
            builder.add_cylinder_visual(
                radius=self.goal_radius_m, half_length=DISC_HALF_THICKNESS_M, material=material
            )
        builder.initial_pose = self._parked_disc(name)
        return builder.build_kinematic(name=name)

    def _parked_disc(self, name: str) -> sapien.Pose:
        pose = self.parking_pose(name, half_height_m=DISC_Z_M)
        return sapien.Pose(p=pose.p, q=list(Z_UP_WXYZ))

    def _sample_episode(self, env: int) -> None:
        layout = self.episode_generator(env, Stream.LAYOUT)
        drawn = int(self.episode_generator(env, Stream.TARGET).integers(len(START_BANDS_Y_M)))
        band_m = START_BANDS_Y_M[(drawn + self.swap_cue) % len(START_BANDS_Y_M)]
        x, y = layout.uniform(*START_X_M), band_m + layout.uniform(0, START_BAND_WIDTH_M)
        self._first_place[env] = (x, y, self.cube_half_size_m)
        self._goal_position[env] = (layout.uniform(*GOAL_X_M), layout.uniform(*GOAL_Y_M), DISC_Z_M)

    def n_swaps(self) -> int:
        """Return in how many other bands the cube could lie."""
        return limits.n_swaps()

    def _on_episode_start(self, mask: Flags) -> None:
        self._goal_reached[mask] = False
        self.move(self.cube, mask, poses(self._first_place))
        self._color_goal(mask, np.zeros_like(mask))

    def _color_goal(self, mask: Flags, violet: Flags) -> None:
        """Show the violet disc where `mask` and `violet` hold, the red one where only `mask` does."""
        if not anywhere(mask):
            return
        at_goal = poses(self._goal_position, Z_UP_WXYZ)
        for disc, shown in ((self.red_disc, mask & ~violet), (self.violet_disc, mask & violet)):
            self.move(disc, shown, at_goal)
            self.move(disc, mask & ~shown, self._parked_disc(disc.name))
        self._is_violet[mask] = violet[mask]

    def _cube_distance_m(self, place: FloatArray) -> FloatArray:
        return length((position_of(self.cube) - place)[:, :2])

    def _in_goal(self) -> Flags:
        return self._cube_distance_m(self._goal_position) < self.goal_radius_m

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        # No phase begins, but the disc changes colour when the cube reaches it or leaves it.
        in_goal = self._in_goal()
        violet = in_goal | (self._goal_reached & self.latch_goal_color)
        changed = mask & (step > 0) & (violet != self._is_violet)
        self._color_goal(changed, violet)
        return anywhere(changed)

    def _update_latches(self, step: Steps) -> None:
        self._goal_reached |= self._in_goal()

    def evaluate(self) -> Info:
        """Read success: the goal was reached and the cube is back at this step; changes nothing."""
        is_back = self._cube_distance_m(self._first_place) < self.return_radius_m
        return {
            "success": self._goal_reached & is_back,
            "goal_achieved": self._in_goal(),
            "goal_reached_status": self._goal_reached.copy(),
            "is_robot_static": self.is_static(),
        }

    def used_areas(self) -> tuple[Area, ...]:
        """Return where cube and disc can lie, with the hand around the cube on its way."""
        return used_areas(
            goal_radius_m=self.goal_radius_m,
            return_radius_m=self.return_radius_m,
            cube_half_size_m=self.cube_half_size_m,
        )

    def moving_bodies(self) -> dict[str, Body]:
        """Return `cube`, `goal`, `first_place` and `violet_disc`, which is below the table while red."""
        return {
            "cube": moving_body(position_of(self.cube), velocity_of(self.cube)),
            "goal": resting_body(self._goal_position),
            "violet_disc": resting_body(position_of(self.violet_disc)),
            "first_place": resting_body(self._first_place),
        }

    def oracle_info(self) -> FloatArray:
        """Return (B, 3): where the cube's centre was at the start, m, world frame."""
        return self._first_place

    def reward_terms(self, info: Info) -> Info:
        """Push the cube to the goal; once it was there, pull it back."""
        back = self._goal_reached
        contact = position_of(self.cube)
        contact[:, 0] += np.where(back, PULL_AHEAD_M, -PUSH_BEHIND_M)
        distance = length(contact - self.tcp_position_m())
        place = np.where(back[:, None], self._first_place, self._goal_position)
        there = distance < CONTACT_M
        return {
            "reaching": np.where(back, 10.0, 2.0) * nearness(5.0, distance),
            "moving": np.where(back, 15.0, 5.0) * nearness(5.0, self._cube_distance_m(place)) * there,
        }

    def _privileged_extra(self) -> Info:
        return {
            "goal_pos": self._goal_position,
            "cube_pose": pose_of(self.cube),
            "oracle_info": self.oracle_info(),
            "goal_reached_status": self._goal_reached[:, None],
        }
