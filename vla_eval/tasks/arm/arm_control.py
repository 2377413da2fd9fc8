"""The arm: where it is, how an action reaches it, and what replaces actions before the choice.

Knows nothing of objects, rewards or what a task is about.
"""

from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.geometry.rotation_conversions import matrix_to_euler_angles, quaternion_to_matrix

from vla_eval.control_modes import ABSOLUTE_MODES, EE_DELTA_POS, EE_DELTA_POSE, EE_POSE, JOINT_POS
from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.arm.arms import Arm
from vla_eval.tasks.arm.interference import GRIPPER_DIMENSION, Y_DIMENSION, delay_motion
from vla_eval.tasks.objects.bodies import length, yaw_rad


class ArmControl(BaseEnv):  # type: ignore[misc]  # ManiSkill is untyped
    """An environment whose arm can be held still, or moved by a script, whatever the action is."""

    arm: Arm  # the arm's row
    # `static_threshold_rad_s`, `freeze_until_choice`, `move_in_delay`: see `MemoryTableEnv`
    static_threshold_rad_s: float
    freeze_until_choice: bool
    move_in_delay: bool
    # (B, A) the last action as it was carried out; None after a step without one
    executed_action: torch.Tensor | None
    _cue_end_step: torch.Tensor
    _response_step: torch.Tensor

    def tcp_position_m(self) -> torch.Tensor:
        """Return the (B, 3) tool centre point, world frame."""
        position: torch.Tensor = self.agent.tcp.pose.p
        return position

    def tcp_yaw_rad(self) -> torch.Tensor:
        """Return (B,): the gripper's yaw about world z; 0 with the fingers aligned along y."""
        return yaw_rad(self.agent.tcp.pose.q)

    def gripper_width_m(self) -> torch.Tensor:
        """Return the (B,) gap between the fingers."""
        width: torch.Tensor = self.agent.robot.get_qpos()[:, -2:].sum(dim=1)
        return width

    def is_static(self) -> torch.Tensor:
        """Return (B,) bool: no arm joint moves faster than the threshold."""
        static: torch.Tensor = self.agent.is_static(self.static_threshold_rad_s)
        return static

    def arm_speed(self) -> torch.Tensor:
        """Return the (B,) Euclidean norm of the arm's joint velocities, rad/s."""
        return length(self.agent.robot.get_qvel()[:, list(self.arm.arm_joints)])

    def check_motion(self) -> None:
        """Raise `TaskArgumentError` if the scripted motion cannot be made in this control mode."""
        if self.move_in_delay and self.control_mode not in (EE_DELTA_POSE, EE_DELTA_POS):
            raise TaskArgumentError(
                f"move_in_delay with control_mode={self.control_mode!r}: its motion is given in "
                f"{EE_DELTA_POSE} and {EE_DELTA_POS} only. Use one of these modes, or leave it out."
            )

    def hold_action(self) -> torch.Tensor:
        """Return the (B, A) action that moves neither arm nor fingers, with the present gripper width.

        In a delta mode all motions are 0; in `pd_joint_pos` it is the joints' present targets, in
        `pd_ee_pose` the present pose.

        Raises:
            TaskArgumentError: the control mode has no action for that.
        """
        action = torch.zeros(self.num_envs, self.single_action_space.shape[0], device=self.device)
        arm = self.agent.controller.controllers["arm"]
        if self.control_mode == JOINT_POS:
            action[:, :-1] = arm._target_qpos
        elif self.control_mode == EE_POSE:
            pose = arm.ee_pose_at_base
            action[:, :3] = pose.p
            action[:, 3:6] = matrix_to_euler_angles(quaternion_to_matrix(pose.q), "XYZ")
        elif "delta" not in self.control_mode:
            raise TaskArgumentError(
                f"control_mode={self.control_mode!r}: no action of this mode holds the arm still."
            )
        gripper = self.agent.controller.controllers["gripper"]
        low, high = gripper.config.lower, gripper.config.upper
        width = self.agent.robot.get_qpos()[:, -2:].mean(dim=1)
        action[:, -1] = ((width - low) / (high - low) * 2 - 1).clamp(-1, 1)
        return action

    def _step_action(self, action: Any) -> Any:
        if (self.freeze_until_choice or self.move_in_delay) and action is not None:
            given = torch.as_tensor(np.asarray(action, dtype=np.float32), device=self.device)
            action = self._replaced(given.reshape(self.num_envs, -1))
        if self.control_mode in ABSOLUTE_MODES and action is not None:
            action = self._clipped(torch.as_tensor(action, dtype=torch.float32, device=self.device))
        executed = super()._step_action(action)
        self.executed_action = None if executed is None else self._clipped(executed)
        return executed

    def _clipped(self, action: torch.Tensor) -> torch.Tensor:
        """Return the action within its bounds: ManiSkill clips only numbers that it scales."""
        low, high = (
            torch.as_tensor(bound, device=self.device)
            for bound in (self.single_action_space.low, self.single_action_space.high)
        )
        return action.clamp(low, high)

    def _replaced(self, action: torch.Tensor) -> torch.Tensor:
        """Return the (B, A) action with what holds or moves the arm before the choice in its place."""
        action, held = action.clone(), self.hold_action()  # not the caller's array
        if self.freeze_until_choice:
            action = torch.where((self._elapsed_steps < self._response_step)[:, None], held, action)
        for env in range(self.num_envs) if self.move_in_delay else ():
            begins, ends = int(self._cue_end_step[env]), int(self._response_step[env])
            motion = delay_motion(int(self._elapsed_steps[env]), begins=begins, ends=ends)
            if motion is not None:
                action[env] = torch.zeros_like(held[env])
                action[env, Y_DIMENSION], action[env, GRIPPER_DIMENSION] = motion
        return action
