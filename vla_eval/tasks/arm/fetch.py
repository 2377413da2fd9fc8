"""ManiSkill's Fetch at the table; importing it registers the arm."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from gymnasium.spaces import Box
from mani_skill.agents.controllers import PassiveController, PassiveControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.fetch import Fetch
from mani_skill.sensors.camera import CameraConfig

from vla_eval.robots.rows import FETCH
from vla_eval.tasks.arm.hands import hand_camera

HOLDING = 1e5  # N·s/m, N·m·s/rad: a joint with this damping does not move by itself


class _Still(PassiveController):  # type: ignore[misc]  # ManiSkill is untyped
    """Joints without a command; ManiSkill's own class uses a float64 box, for which Gymnasium warns."""

    def _initialize_action_space(self) -> None:
        none = np.empty(0, dtype=np.float32)
        self.single_action_space = Box(none, none, dtype=np.float32)


@dataclass
class StillConfig(PassiveControllerConfig):  # type: ignore[misc]  # ManiSkill is untyped
    """Joints without a command, held or left free by their damping."""

    controller_cls = _Still


@register_agent()
class FetchAtTable(Fetch):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's Fetch, standing still in front of the table: only its arm and gripper are commanded."""

    (uid,) = FETCH.uids

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        """The wrist camera: on the hand, behind the fingers and above them, looking along them."""
        return hand_camera(self.robot.links_map["gripper_link"], sapien.Pose(p=[-0.1, 0, 0.1]))

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:  # Any: ManiSkill's configurations
        """Fetch's own, except base, torso and head, which are held by damping and take no command."""
        still = StillConfig(
            self.base_joint_names + self.body_joint_names, damping=HOLDING, force_limit=HOLDING
        )
        return {
            mode: {"arm": parts["arm"], "gripper": parts["gripper"], "still": still}
            for mode, parts in super()._controller_configs.items()
        }
