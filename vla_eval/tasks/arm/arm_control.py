"""The arm: where it is, how an action reaches it, and what replaces actions before the choice.

Arrays begin here: what ManiSkill keeps as tensors is read as numpy, (B, …) float32. Knows nothing of
objects, rewards or what a task is about.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.geometry.rotation_conversions import matrix_to_euler_angles, quaternion_to_matrix
from mani_skill.utils.sapien_utils import get_pairwise_contacts

from vla_eval.control_modes import ABSOLUTE_MODES, EE_POSE, JOINT_POS
from vla_eval.core import FloatArray
from vla_eval.errors import TaskArgumentError
from vla_eval.robots.arm import Arm
from vla_eval.tasks.arm.drives import Drive, drives_of
from vla_eval.tasks.arm.interference import GRIPPER_DIMENSION, Y_DIMENSION, delay_motion
from vla_eval.tasks.objects.bodies import (
    Flags,
    Indices,
    Steps,
    anywhere,
    length,
    pose_of,
    position_of,
    to_array,
    yaw_rad,
)


class ArmControl(BaseEnv):  # type: ignore[misc]  # ManiSkill is untyped
    """An environment whose arm can be held still, or moved by a script, whatever the action is."""

    arm: Arm  # the arm's row
    # `static_threshold_rad_s`, `freeze_until_choice`, `move_in_delay`: see `MemoryTableEnv`
    static_threshold_rad_s: float
    freeze_until_choice: bool
    move_in_delay: bool
    # (B, A) the last action as it was carried out; None after a step without one
    executed_action: FloatArray | None
    _cue_end_step: Steps
    _response_step: Steps

    def step_count(self) -> Steps:
        """Return (B,) the control steps since the reset; on the CPU simulator not a copy."""
        if self._counted is not self._elapsed_steps or self.gpu_sim_enabled:
            self._counted = self._elapsed_steps
            self._count = self._counted.cpu().numpy()
        return self._count

    _counted: Any = None  # the tensor of which `_count` is the memory, on the CPU simulator
    _count: Steps

    def qpos(self) -> FloatArray:
        """Return the (B, J) joint positions, rad, and m for the fingers."""
        if self.gpu_sim_enabled:
            return to_array(self.agent.robot.get_qpos())
        positions: FloatArray = self.agent.robot._objs[0].qpos[None]
        return positions

    def qvel(self) -> FloatArray:
        """Return the (B, J) joint velocities, rad/s, and m/s for the fingers."""
        if self.gpu_sim_enabled:
            return to_array(self.agent.robot.get_qvel())
        velocities: FloatArray = self.agent.robot._objs[0].qvel[None]
        return velocities

    def tcp_pose(self) -> FloatArray:
        """Return (B, 7): position and rotation (wxyz) of the tool centre point, world frame."""
        return pose_of(self.agent.tcp)

    def tcp_position_m(self) -> FloatArray:
        """Return the (B, 3) tool centre point, world frame."""
        return position_of(self.agent.tcp)

    def tcp_yaw_rad(self) -> FloatArray:
        """Return (B,): the gripper's yaw about world z; 0 with the fingers aligned along y."""
        return yaw_rad(self.tcp_pose()[:, 3:])

    def gripper_width_m(self) -> FloatArray:
        """Return the (B,) gap between the fingers."""
        return self.arm.gripper.width_m(self.qpos())

    def arm_qvel(self) -> FloatArray:
        """Return the (B, J) velocities of the joints that move the hand, rad/s."""
        if self._arm_joints is None:
            self._arm_joints = np.array(self.arm.arm_joints)
        return self.qvel().take(self._arm_joints, axis=1)

    _arm_joints: Indices | None = None

    def is_static(self) -> Flags:
        """Return (B,) bool: no arm joint moves faster than the threshold."""
        fastest = np.maximum.reduce(np.abs(self.arm_qvel()), axis=1)
        static: Flags = fastest <= self.static_threshold_rad_s
        return static

    def arm_speed(self) -> FloatArray:
        """Return the (B,) Euclidean norm of the arm's joint velocities, rad/s."""
        return length(self.arm_qvel())

    def grasps(self, actor: Any) -> Flags:
        """Return (B,) bool: both fingers press an actor, with at least 0.5 N (ManiSkill's rule)."""
        if not self.gpu_sim_enabled:
            # Its rule takes 0.5 ms; most of the time a finger does not touch the actor at all.
            contacts, held = self.scene.px.get_contacts(), actor._bodies[0].entity
            fingers = (self.agent.finger1_link, self.agent.finger2_link)
            touches = (get_pairwise_contacts(contacts, one._bodies[0].entity, held) for one in fingers)
            if not all(touches):
                return np.zeros(1, dtype=np.bool_)
        grasped: Flags = self.agent.is_grasping(actor).cpu().numpy()
        return grasped

    def hold_action(self) -> FloatArray:
        """Return the (B, A) action that moves neither arm nor fingers, with the present gripper width.

        In a delta mode all motions are 0; in `pd_joint_pos` it is the joints' present targets, in
        `pd_ee_pose` the present pose.

        Raises:
            TaskArgumentError: the control mode has no action for that.
        """
        action = np.zeros((self.num_envs, self.single_action_space.shape[0]), dtype=np.float32)
        arm = self.agent.controller.controllers["arm"]
        if self.control_mode == JOINT_POS:
            action[:, :-1] = self.joint_targets()
        elif self.control_mode == EE_POSE:
            pose = arm.ee_pose_at_base
            action[:, :3] = to_array(pose.p)
            action[:, 3:6] = to_array(matrix_to_euler_angles(quaternion_to_matrix(pose.q), "XYZ"))
        elif "delta" not in self.control_mode:
            raise TaskArgumentError(
                f"control_mode={self.control_mode!r}: no action of this mode holds the arm still."
            )
        gripper = self.arm.gripper
        low, high = gripper.closed, gripper.opened
        position = gripper.position(self.qpos())
        action[:, -1] = ((position - low) / (high - low) * 2 - 1).clip(-1, 1)
        return action

    def joint_targets(self) -> FloatArray:
        """Return the (B, J) joint positions, rad, at which the arm aims since the last action."""
        return to_array(self.agent.controller.controllers["arm"]._target_qpos)

    # A control step is `drive_together`, `simulate` and `finish`. Environments that step together do each of
    # them in turn: what it needs is then in the processor's caches.

    def simulate(self) -> None:
        """Let the time of one control step pass."""
        if self.gpu_sim_enabled:
            super()._step_action(torch.as_tensor(self._driven_action, device=self.device))
            return
        step = self.scene.px.step
        for _ in range(self._sim_steps_per_control):
            step()

    def finish(self) -> None:
        """Hide and reveal objects, record what happened, and count the step."""
        if self.gpu_sim_enabled:  # ManiSkill's own step has done the rest
            self._elapsed_steps += 1
            return
        self._after_control_step()
        self.step_count()[:] += 1

    _driven: Any = None  # the controller that the drives are of; a new scene has another one

    def _drives(self) -> list[tuple[slice, Drive]]:
        if self._driven is not self.agent.controller:
            self._driven, self._parts = self.agent.controller, drives_of(self.agent)
        return self._parts

    def _step_action(self, action: Any) -> Any:
        if action is None or isinstance(action, dict):  # ManiSkill's other forms
            self.executed_action = None
            return super()._step_action(action)
        given = to_array(action) if torch.is_tensor(action) else np.asarray(action, dtype=np.float32)
        drive_together([self], given.reshape(self.num_envs, -1))
        self.simulate()
        if not self.gpu_sim_enabled:
            self._after_control_step()
        return torch.as_tensor(given, device=self.device)

    def _replaced(self, actions: FloatArray) -> FloatArray:
        """Return the (B, A) actions with what holds or moves the arm before the choice in their place."""
        replaced, held, steps = actions.copy(), self.hold_action(), self.step_count()
        if self.freeze_until_choice:
            frozen = steps < self._response_step
            replaced[frozen] = held[frozen]
        for env in range(self.num_envs) if self.move_in_delay else ():
            begins, ends = int(self._cue_end_step[env]), int(self._response_step[env])
            motion = delay_motion(int(steps[env]), begins=begins, ends=ends)
            if motion is not None:
                replaced[env] = 0
                replaced[env, Y_DIMENSION], replaced[env, GRIPPER_DIMENSION] = motion
        return replaced


def drive_together(envs: Sequence[ArmControl], actions: FloatArray) -> None:
    """Give actions (N, A), float32, to environments alike: `executed_action` says what will be done.

    There is one environment, or several on the CPU simulator. A `ValueError` refuses what is not a number.
    """
    if anywhere(np.isnan(actions)):
        raise ValueError(f"An action is not a number: {actions.tolist()}.")
    first, by_env = envs[0], (len(envs), -1, actions.shape[1])
    if first.freeze_until_choice or first.move_in_delay:
        of_envs = zip(envs, actions.reshape(by_env), strict=True)
        actions = np.concatenate([env._replaced(rows) for env, rows in of_envs])
    space = first.single_action_space
    executed = np.minimum(np.maximum(actions, space.low), space.high)
    for env, rows in zip(envs, executed.reshape(by_env), strict=True):
        env.executed_action = rows
    # ManiSkill clips only numbers that it scales.
    driven = executed if first.control_mode in ABSOLUTE_MODES else actions
    if first.gpu_sim_enabled:
        first._driven_action = driven
        return
    for parts in zip(*(env._drives() for env in envs), strict=True):
        part, shared = parts[0]
        for (_, drive), goal in zip(parts, shared.goals(driven[:, part]), strict=True):
            drive.reach(goal)
