"""ManiSkill's controllers for one arm on the CPU simulator, without a tensor for every number.

The same arithmetic in the same order, so the joints' targets are equal to the last bit: float32 throughout,
torch's own sine, cosine, square root and norm (numpy rounds differently), the same inverse kinematics.
ManiSkill's controllers take 43 % of a control step if there is one arm.

Source: https://github.com/haosulab/ManiSkill/blob/628bbe64e2c925d9d543171361a86c4a4965c6e9/mani_skill/agents/controllers
"""

from collections.abc import Callable, Sequence
from typing import Any  # ManiSkill is untyped: agents, controllers and links are Any here

import numpy as np
import sapien
import torch
from mani_skill.agents.controllers import (
    PDEEPosController,
    PDEEPoseController,
    PDJointPosController,
    PDJointPosMimicController,
)

from vla_eval.core import FloatArray

Number = np.float32
Numbers = Sequence[Number] | FloatArray
Quaternion = tuple[Number, Number, Number, Number]
Vector = tuple[Number, Number, Number]
Drive = Callable[[FloatArray], None]
"""Sets the targets of the joints of one controller to its part of an action."""

ZERO, ONE = np.float32(0), np.float32(1)
LEAST = np.float32(0.1)  # of what quaternions are divided by
MAX_ITERATIONS = 100  # of the inverse kinematics, as in ManiSkill
SURELY_SHORT = 0.999  # a rotation's square sum up to which its norm rounds to 1 at most


def drives_of(agent: Any) -> list[tuple[slice, Drive]]:
    """Return, for each controller of the agent's present mode, its part of an action and what drives it."""
    combined = agent.controller
    return [
        (slice(*combined.action_mapping[name]), _drive_of(controller))
        for name, controller in combined.controllers.items()
    ]


def _drive_of(controller: Any) -> Drive:
    """Return ManiSkill's own way where the controller is not one of those below."""
    config = controller.config
    plain = not getattr(config, "use_target", False) and not getattr(config, "interpolate", False)
    make = DRIVES.get(type(controller)) if plain and getattr(config, "frame", FRAME) == FRAME else None
    if make is None:
        return lambda action: controller.set_action(torch.from_numpy(action)[None])
    return make(controller)


FRAME = "root_translation:root_aligned_body_rotation"


class _Joints:
    """The joints of one controller: their positions, and their targets for the drives."""

    def __init__(self, controller: Any) -> None:
        self._controller = controller
        self._robot = controller.articulation._objs[0]
        self._set_targets = [joint._objs[0].set_drive_target for joint in controller.joints]
        self._indices = controller.active_joint_indices.numpy()
        self._shared = torch.zeros((1, len(controller.joints)))  # one memory for a tensor and an array
        self._targets: FloatArray = self._shared.numpy()

    def qpos(self) -> FloatArray:
        found: FloatArray = self._robot.qpos[self._indices]
        return found

    def drive_to(self, targets: FloatArray) -> None:
        self._targets[0] = targets
        # ManiSkill's name for it: `joint_targets` reads it, and a controller's reset writes it.
        self._controller._target_qpos = self._shared
        for set_target, target in zip(self._set_targets, targets.tolist(), strict=True):
            set_target(target)


def _scaling(controller: Any, part: slice = slice(None)) -> Callable[[FloatArray], FloatArray]:
    """Return what turns this part of an action into the controller's units."""
    if not controller._normalize_action:
        return lambda action: action
    low, high = controller.action_space_low[part].numpy(), controller.action_space_high[part].numpy()
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    return lambda action: middle + half * np.minimum(np.maximum(action, -ONE), ONE)


def _joint_drive(controller: Any) -> Drive:
    joints, scaled, is_delta = _Joints(controller), _scaling(controller), controller.config.use_delta

    def drive(action: FloatArray) -> None:
        targets = scaled(action)
        joints.drive_to(joints.qpos() + targets if is_delta else targets.copy())

    return drive


def _mimic_drive(controller: Any) -> Drive:
    if controller.config.use_delta:
        return lambda action: controller.set_action(torch.from_numpy(action)[None])
    joints, scaled = _Joints(controller), _scaling(controller)
    controls = controller.control_joint_indices.numpy()
    mimics, of = controller.mimic_joint_indices.numpy(), controller.mimic_control_joint_indices.numpy()
    n = len(controls) + len(mimics)
    source, multiplier, offset = np.zeros(n, np.intp), np.ones(n, np.float32), np.zeros(n, np.float32)
    source[controls] = np.arange(len(controls))
    source[mimics] = source[of]
    multiplier[mimics], offset[mimics] = controller._multiplier.numpy(), controller._offset.numpy()
    return lambda action: joints.drive_to(scaled(action)[source] * multiplier + offset)


def _pose_drive(controller: Any) -> Drive:
    """Return what brings the tool centre point to a pose, by the inverse kinematics of SAPIEN's Pinocchio."""
    joints, config, kinematics = _Joints(controller), controller.config, controller.kinematics
    root, tip = controller.root_link._objs[0], controller.ee_link._objs[0]
    model, link, mask = kinematics.pmodel, kinematics.end_link_idx, kinematics.qmask.numpy()
    chain, controlled = (
        indices.numpy()
        for indices in (kinematics.pmodel_active_joint_indices, kinematics.pmodel_controlled_joint_indices)
    )
    scaled, at_base = _pose_scaling(controller), _at_base(root.entity_pose)
    # By its configuration: the robot's own root stands still, another link may move.
    moving_base = config.root_link_name is not None

    def drive(action: FloatArray) -> None:
        position, rotation = scaled(action)
        if config.use_delta:
            here_m, here = (_at_base(root.entity_pose) if moving_base else at_base)(tip.entity_pose)
            position = here_m + position
            # ManiSkill also multiplies where the action does not turn the hand.
            rotation = _standard(_product((ONE, ZERO, ZERO, ZERO) if rotation is None else rotation, here))
        qpos = joints._robot.qpos
        found, success, _ = model.compute_inverse_kinematics(
            link,
            sapien.Pose(position, rotation),
            initial_qpos=qpos[chain],
            active_qmask=mask,
            max_iterations=MAX_ITERATIONS,
        )
        joints.drive_to(found[controlled].astype(np.float32) if success else qpos[joints._indices])

    return drive


def _pose_scaling(controller: Any) -> Callable[[FloatArray], tuple[FloatArray, Quaternion | None]]:
    """Return what turns an action into a translation and, where it has one, a rotation."""
    if not isinstance(controller, PDEEPoseController):
        translation = _scaling(controller)
        return lambda action: (translation(action), None)
    from_euler = _euler()
    if not controller._normalize_action:
        return lambda action: (action[:3], from_euler(action[3:]))
    translation = _scaling(controller, slice(3))
    unit_rad = np.float32(controller.config.rot_lower)

    def scaled(action: FloatArray) -> tuple[FloatArray, Quaternion]:
        turn = action[3:]
        x, y, z = turn.tolist()
        if x * x + y * y + z * z > SURELY_SHORT:  # torch's norm is asked only where it could be above 1
            norm = torch.linalg.norm(torch.from_numpy(turn)[None], dim=1).numpy()[0]
            if norm > 1:
                turn = turn * (ONE / norm)
        return translation(action[:3]), from_euler(turn * unit_rad)

    return scaled


DRIVES: dict[type, Callable[[Any], Drive]] = {
    PDEEPoseController: _pose_drive,
    PDEEPosController: _pose_drive,
    PDJointPosController: _joint_drive,
    PDJointPosMimicController: _mimic_drive,
}
"""ManiSkill's class -> what makes its drive. An arm with other controllers keeps theirs."""


# ---------------------------------------------------------------- rotations, as ManiSkill computes them


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _standard(q: Quaternion) -> Quaternion:
    """Return the same rotation with a real part that is not negative."""
    return (-q[0], -q[1], -q[2], -q[3]) if q[0] < 0 else q


def _rotated(q: Quaternion, point: Vector) -> FloatArray:
    inverse = (q[0], -q[1], -q[2], -q[3])
    return np.array(_product(_product(q, (ZERO, *point)), inverse)[1:], dtype=np.float32)


def _at_base(base: sapien.Pose) -> Callable[[sapien.Pose], tuple[FloatArray, Quaternion]]:
    """Return what turns a pose into position and rotation in the frame of the base."""
    w, x, y, z = base.q
    inverse = (w, -x, -y, -z)
    offset = _rotated(inverse, tuple(-base.p))
    return lambda tip: (
        offset + _rotated(inverse, tuple(tip.p)),
        _standard(_product(inverse, tuple(tip.q))),
    )


def _of_torch(function: Callable[..., object], n: int) -> Callable[[Numbers], FloatArray]:
    """Return torch's function for n numbers, without new tensors: each answer overwrites the last."""
    tensors = torch.zeros(n), torch.zeros(n)
    given, found = (tensor.numpy() for tensor in tensors)

    def apply(numbers: Numbers) -> FloatArray:
        given[:] = numbers
        function(tensors[0], out=tensors[1])
        return found

    return apply


def _euler() -> Callable[[FloatArray], Quaternion]:
    """Return what makes the rotation about x, then about the new y, then about the new z."""
    cosine, sine, root = _of_torch(torch.cos, 3), _of_torch(torch.sin, 3), _of_torch(torch.sqrt, 4)

    def from_euler(angles_rad: FloatArray) -> Quaternion:
        cx, cy, cz = cosine(angles_rad)
        sx, sy, sz = sine(angles_rad)
        # The product of the three matrices: what is multiplied by 0 or 1 rounds nothing.
        a, b = sx * sy, -cx * sy
        m00, m01, m02 = cy * cz, cy * -sz, sy
        m10, m11, m12 = a * cz + cx * sz, a * -sz + cx * cz, -sx * cy
        m20, m21, m22 = b * cz + sx * sz, b * -sz + sx * cz, cx * cy
        squares = (ONE + m00 + m11 + m22, ONE + m00 - m11 - m22, ONE - m00 + m11 - m22, ONE - m00 - m11 + m22)
        roots = root([max(square, ZERO) for square in squares])
        w, x, y, z = roots
        rows = (
            (w * w, m21 - m12, m02 - m20, m10 - m01),
            (m21 - m12, x * x, m10 + m01, m02 + m20),
            (m02 - m20, m10 + m01, y * y, m12 + m21),
            (m10 - m01, m20 + m02, m21 + m12, z * z),
        )
        best = int(roots.argmax())
        twice, row = np.float32(2) * max(roots[best], LEAST), rows[best]
        return _standard((row[0] / twice, row[1] / twice, row[2] / twice, row[3] / twice))

    return from_euler
