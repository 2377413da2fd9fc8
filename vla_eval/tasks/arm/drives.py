"""ManiSkill's controllers for one arm on the CPU simulator, without a tensor for every number.

The same arithmetic in the same order, so the joints' targets are equal to the last bit: float32 throughout,
torch's own sine, cosine, square root and norm (numpy rounds differently), the same inverse kinematics.
ManiSkill's controllers take 43 % of a control step if there is one arm.

Source: https://github.com/haosulab/ManiSkill/blob/628bbe64e2c925d9d543171361a86c4a4965c6e9/mani_skill/agents/controllers
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple  # ManiSkill is untyped: agents, controllers and links are Any here

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
Quaternion = tuple[Number, Number, Number, Number]
Vector = tuple[Number, Number, Number]


class Drive(NamedTuple):
    """What drives the joints of one controller, in two parts: arms that step together share the first."""

    # (N, D), this controller's part of the actions of N arms alike -> a goal for each
    goals: Callable[[FloatArray], Iterable[Any]]
    reach: Callable[[Any], None]  # sets the targets of this arm's joints by a goal


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
    make = DRIVES.get(type(controller)) if plain and getattr(config, "frame", FRAME) in FRAMES else None
    if make is None:
        return _own_drive(controller)
    return make(controller)


def _own_drive(controller: Any) -> Drive:
    return Drive(list, lambda action: controller.set_action(torch.from_numpy(action)[None]))


FRAME = "root_translation:root_aligned_body_rotation"
FRAMES = (FRAME, "root_translation")
"""Moved along the axes of the root; a mode that does not turn the hand has no more to its name."""


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
    joints, is_delta = _Joints(controller), controller.config.use_delta
    return Drive(
        _scaling(controller), lambda goal: joints.drive_to(joints.qpos() + goal if is_delta else goal)
    )


def _mimic_drive(controller: Any) -> Drive:
    if controller.config.use_delta:
        return _own_drive(controller)
    joints, scaled = _Joints(controller), _scaling(controller)
    controls = controller.control_joint_indices.numpy()
    mimics, of = controller.mimic_joint_indices.numpy(), controller.mimic_control_joint_indices.numpy()
    n = len(controls) + len(mimics)
    source, multiplier, offset = np.zeros(n, np.intp), np.ones(n, np.float32), np.zeros(n, np.float32)
    source[controls] = np.arange(len(controls))
    source[mimics] = source[of]
    multiplier[mimics], offset[mimics] = controller._multiplier.numpy(), controller._offset.numpy()
    return Drive(lambda actions: scaled(actions)[:, source] * multiplier + offset, joints.drive_to)


def _pose_drive(controller: Any) -> Drive:
    """Return what brings the tool centre point to a pose, by the inverse kinematics of SAPIEN's Pinocchio."""
    joints, config, kinematics = _Joints(controller), controller.config, controller.kinematics
    root, tip = controller.root_link._objs[0], controller.ee_link._objs[0]
    model, link, mask = kinematics.pmodel, kinematics.end_link_idx, kinematics.qmask.numpy()
    chain, controlled = (
        indices.numpy()
        for indices in (kinematics.pmodel_active_joint_indices, kinematics.pmodel_controlled_joint_indices)
    )
    at_base = _at_base(root.entity_pose)
    # By its configuration: the robot's own root stands still, another link may move.
    moving_base = config.root_link_name is not None

    def reach(goal: tuple[FloatArray, Quaternion | None]) -> None:
        position, rotation = goal
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

    return Drive(_pose_goals(controller), reach)


def _pose_goals(controller: Any) -> Callable[[FloatArray], Iterable[tuple[FloatArray, Quaternion | None]]]:
    """Return what turns actions into translations and, where they have some, rotations."""
    if not isinstance(controller, PDEEPoseController):
        translation = _scaling(controller)
        return lambda actions: [(position, None) for position in translation(actions)]
    if not controller._normalize_action:
        return lambda actions: list(zip(actions[:, :3], _from_euler(actions[:, 3:]), strict=True))
    translation = _scaling(controller, slice(3))
    unit_rad = np.float32(controller.config.rot_lower)

    def goals(actions: FloatArray) -> list[tuple[FloatArray, Quaternion]]:
        turns = np.ascontiguousarray(actions[:, 3:])
        # torch's norm is asked only where it could be above 1.
        if any(x * x + y * y + z * z > SURELY_SHORT for x, y, z in turns.tolist()):
            norms = torch.linalg.norm(torch.from_numpy(turns), dim=1, keepdim=True).numpy()
            turns = turns * (ONE / np.maximum(norms, ONE))
        return list(zip(translation(actions[:, :3]), _from_euler(turns * unit_rad), strict=True))

    return goals


DRIVES: dict[type, Callable[[Any], Drive]] = {
    PDEEPoseController: _pose_drive,
    PDEEPosController: _pose_drive,
    PDJointPosController: _joint_drive,
    PDJointPosMimicController: _mimic_drive,
}
"""ManiSkill's class -> what makes its drive. An arm with other controllers keeps theirs."""


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
    return lambda tip: (offset + _rotated(inverse, tuple(tip.p)), _standard(_product(inverse, tuple(tip.q))))


def _from_euler(angles_rad: FloatArray) -> list[Quaternion]:
    """Return for each of (N, 3) angles the rotation about x, then about the new y, then about the new z."""
    angles = torch.from_numpy(np.ascontiguousarray(angles_rad))
    turned = list(map(_multiples, torch.cos(angles).numpy(), torch.sin(angles).numpy()))
    squares = np.array([[row[i] for i, row in enumerate(rows)] for rows in turned])
    found = []
    for rows, roots in zip(turned, torch.sqrt(torch.from_numpy(squares)).numpy(), strict=True):
        best = int(roots.argmax())
        row, root = list(rows[best]), roots[best]
        row[best] = root * root
        twice = np.float32(2) * max(root, LEAST)
        found.append(_standard((row[0] / twice, row[1] / twice, row[2] / twice, row[3] / twice)))
    return found


def _multiples(cosines: Vector, sines: Vector) -> tuple[Quaternion, Quaternion, Quaternion, Quaternion]:
    """Return the rotation, as a quaternion, times 4 w, times 4 x, times 4 y and times 4 z."""
    (cx, cy, cz), (sx, sy, sz) = cosines, sines
    # The product of the three matrices: what is multiplied by 0 or 1 rounds nothing.
    a, b = sx * sy, -cx * sy
    m00, m01, m02 = cy * cz, cy * -sz, sy
    m10, m11, m12 = a * cz + cx * sz, a * -sz + cx * cz, -sx * cy
    m20, m21, m22 = b * cz + sx * sz, b * -sz + sx * cz, cx * cy
    wx, wy, wz, xy, xz, yz = m21 - m12, m02 - m20, m10 - m01, m10 + m01, m02 + m20, m12 + m21
    return (
        (max(ONE + m00 + m11 + m22, ZERO), wx, wy, wz),
        (wx, max(ONE + m00 - m11 - m22, ZERO), xy, xz),
        (wy, xy, max(ONE - m00 + m11 - m22, ZERO), yz),
        (wz, xz, yz, max(ONE - m00 - m11 + m22, ZERO)),
    )
