"""The kinematics of an arm from its chain of hinges: where the hand is, and joints that bring it somewhere.

For arms that cannot have every pose of the hand: the position comes first, and the orientation as far as it
goes. Poses are (4, 4), in the world frame.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles.kinematics import Matrix
from vla_eval.robots.arm import Arm, Chain, Hinge, Xyz

# A tilt of 1 rad counts as much as a distance of 5 mm: where the arm reaches a point only with a tilted hand,
# the hand tilts, and the point is missed by less than 1 mm. The turn counts more: experts grasp by it.
TILT_M_PER_RAD, TURN_M_PER_RAD = 0.005, 0.02
MAX_ITERATIONS = 60
CLOSE_RAD = 1e-3  # a step of the joints by less: the inverse is found
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-8, 1.0
EASED, RAISED = 1 / 5, 6.0  # factors of the damping after a step that helped, and after one that did not


class HandPose(NamedTuple):
    """The tool's pose, and of each joint its place (J, 3), m, and its axis (J, 3)."""

    tool: Matrix
    points_m: Matrix
    axes: Matrix


def hand_pose(arm: Arm, joints_rad: NDArray[np.float64]) -> HandPose:
    """Return where the hand of an arm with a chain is, by the (J,) positions of the joints that move it."""
    assert arm.chain is not None  # such arms alone are asked
    parts = _parts(arm.chain)
    pose = _base(arm)
    points, axes = [], []
    for fixed, axis, cross, square, angle_rad in zip(*parts, joints_rad.tolist(), strict=True):
        pose = pose @ fixed
        points.append(pose[:3, 3])
        axes.append(pose[:3, :3] @ axis)
        pose = pose @ _rotation(cross, square, angle_rad)
    return HandPose(pose @ _fixed(arm.chain.tool), np.array(points), np.array(axes))


def nearest_joints(
    arm: Arm, position_m: NDArray[np.float64], yaw_rad: float, near_rad: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (J,) joint positions, rad, within their limits, that bring the hand to a place.

    It is turned by an angle about the vertical, and points down as far as it goes. Levenberg-Marquardt from
    a start `near_rad`, with the joints that are at a limit left out.
    """
    assert arm.chain is not None
    low, high = np.array(arm.chain.low_rad), np.array(arm.chain.high_rad)
    joints = np.clip(near_rad, low, high)
    hand, damping = hand_pose(arm, joints), FIRST_DAMPING
    error = _error(position_m, yaw_rad, hand)
    for _ in range(MAX_ITERATIONS):
        jacobian = _jacobian(hand, yaw_rad)
        gradient = jacobian.T @ error
        free = ~(((joints <= low) & (gradient < 0)) | ((joints >= high) & (gradient > 0)))
        step, part = np.zeros(len(joints)), jacobian[:, free]
        step[free] = np.linalg.solve(part.T @ part + damping * np.eye(part.shape[1]), gradient[free])
        draft = np.clip(joints + step, low, high)
        there = hand_pose(arm, draft)
        left = _error(position_m, yaw_rad, there)
        if left @ left >= error @ error:
            damping *= RAISED
            if damping > MOST_DAMPING:
                break
            continue
        moved_rad = float(np.abs(draft - joints).max())
        joints, hand, error, damping = draft, there, left, max(damping * EASED, LEAST_DAMPING)
        if moved_rad < CLOSE_RAD:
            break
    return joints


def _error(position_m: NDArray[np.float64], yaw_rad: float, hand: HandPose) -> NDArray[np.float64]:
    """Return (6,), m: what is missing of the place, of pointing down (x and y), and of the turn."""
    x_axis, z_axis = hand.tool[:3, 0], hand.tool[:3, 2]
    return np.concatenate(
        [
            position_m - hand.tool[:3, 3],
            -TILT_M_PER_RAD * z_axis[:2],
            [-TURN_M_PER_RAD * float(_across(yaw_rad) @ x_axis)],
        ]
    )


def _jacobian(hand: HandPose, yaw_rad: float) -> NDArray[np.float64]:
    """Return (6, J): by how much each rad of a joint reduces `_error`."""
    moved, tilted, turned = (
        np.cross(hand.axes, arm_m).T
        for arm_m in (hand.tool[:3, 3] - hand.points_m, hand.tool[:3, 2], hand.tool[:3, 0])
    )
    return np.vstack([moved, TILT_M_PER_RAD * tilted[:2], TURN_M_PER_RAD * (_across(yaw_rad) @ turned)])


def _across(yaw_rad: float) -> NDArray[np.float64]:
    """Return the horizontal direction in which the tool's x must have no part."""
    return np.array([-math.sin(yaw_rad), math.cos(yaw_rad), 0.0])


class _Parts(NamedTuple):
    """Of each hinge of a chain what its angle does not change."""

    fixed: list[Matrix]  # (4, 4) its pose in the frame before it
    axes: list[Matrix]  # (3,)
    crosses: list[Matrix]  # (4, 4) the cross product with the axis, and its square
    squares: list[Matrix]


@functools.cache
def _parts(chain: Chain) -> _Parts:
    crosses = [_cross(hinge.axis) for hinge in chain.hinges]
    axes = [np.array(hinge.axis) for hinge in chain.hinges]
    return _Parts([_fixed(hinge) for hinge in chain.hinges], axes, crosses, [one @ one for one in crosses])


def _base(arm: Arm) -> Matrix:
    return _fixed(Hinge(origin_m=arm.base_m, rpy_rad=(0.0, 0.0, arm.base_yaw_rad), axis=(0.0, 0.0, 1.0)))


@functools.cache
def _fixed(hinge: Hinge) -> Matrix:
    """Return the pose of a hinge in the frame before it: roll, pitch and yaw about fixed axes, as in URDF."""
    turns = zip(((0, 0, 1), (0, 1, 0), (1, 0, 0)), reversed(hinge.rpy_rad), strict=True)
    pose = np.eye(4)
    for axis, angle_rad in turns:
        cross = _cross(axis)
        pose = pose @ _rotation(cross, cross @ cross, angle_rad)
    pose[:3, 3] = hinge.origin_m
    return pose


def _rotation(cross: Matrix, square: Matrix, angle_rad: float) -> Matrix:
    """Return the (4, 4) rotation about a unit axis (Rodrigues' formula)."""
    return np.eye(4) + math.sin(angle_rad) * cross + (1 - math.cos(angle_rad)) * square


def _cross(axis: Xyz) -> Matrix:
    x, y, z = axis
    return np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0]], dtype=float)
