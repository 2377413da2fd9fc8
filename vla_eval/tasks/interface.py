"""What every task offers to a policy with the Panda, and arguments that all take: durations, image size.

Knows nothing of simulators: a server of policies has none.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import CONTROL_MODE, EE_DELTA_POSE, action_spec
from vla_eval.errors import TaskArgumentError
from vla_eval.features import IMAGE_SIZE_PX, JOINT_NAMES, POSE_NAMES
from vla_eval.robots.find import ROBOT, action_of, robot_named
from vla_eval.robots.rows import PANDA
from vla_eval.specs import CameraSpec, EnvSpec, StateSpec
from vla_eval.strict.bounds import MAX_STEPS

IMAGE_SIZE = "image_size"
"""Name of the argument in `env`: height and width of the images of both cameras, in pixels."""
CAMERA_FOV_RAD = np.pi / 2
BASE_CAMERA_M = ((0.3, 0.0, 0.6), (-0.1, 0.0, 0.1))
"""Where the base camera is and what it points at, world frame: up is up in its image."""
CAMERA_NAMES = ("base_camera", "hand_camera")
CONTROL_HZ = 20.0
ACTION = action_spec(EE_DELTA_POSE)
ANY_TASK = "any task"
"""Stands for the task's id where a policy is made for none in particular."""


StepRange = int | Sequence[int]
"""A duration in control steps, or a range to draw from per episode."""


def step_range(name: str, value: object) -> tuple[int, int]:
    """Return (least, most) of a duration in control steps given as a number or as a pair.

    Raises:
        TaskArgumentError: not a whole number from 0 on, nor a pair of such numbers in order.
    """
    pair = tuple(value) if isinstance(value, list | tuple) else (value, value)
    are_steps = all(type(steps) is int and 0 <= steps <= MAX_STEPS for steps in pair)
    if len(pair) != 2 or not are_steps or pair[0] > pair[1]:
        raise TaskArgumentError(
            f"{name}={value!r:.80}: expected a whole number of control steps, 0 to {MAX_STEPS}, or a pair "
            "(least, most) of them."
        )
    return int(pair[0]), int(pair[1])


def base_camera_axes() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where the base camera is, (3,) in m, and its axes ahead, right and up, (3, 3); world frame."""
    eye, target = (np.array(point) for point in BASE_CAMERA_M)
    ahead = target - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return eye, np.stack([ahead, right, np.cross(right, ahead)])


def cameras(size_px: int = IMAGE_SIZE_PX) -> tuple[CameraSpec, ...]:
    """Return the cameras of every task, with square images."""
    return tuple(
        CameraSpec(name=name, height_px=size_px, width_px=size_px, fov_rad=CAMERA_FOV_RAD)
        for name in CAMERA_NAMES
    )


CAMERAS = cameras()


def states(joints: tuple[str, ...] = JOINT_NAMES, prompt_dims: tuple[str, ...] = ()) -> tuple[StateSpec, ...]:
    """Return the states that every task provides with an arm, and the numbers of the prompt if it has any."""
    offered = (
        StateSpec(name="tcp_pose", dims=POSE_NAMES, unit="m, wxyz quaternion", frame="world"),
        StateSpec(name="qpos", dims=joints, unit="rad, m", frame="joint"),
        StateSpec(name="qvel", dims=joints, unit="rad/s, m/s", frame="joint"),
    )
    if not prompt_dims:
        return offered
    return (*offered, StateSpec(name="task_cue", dims=prompt_dims, unit="rad", frame="world"))


def env_spec(
    *, control_mode: str = EE_DELTA_POSE, image_size_px: int = IMAGE_SIZE_PX, robot: str = PANDA.name
) -> EnvSpec:
    """Return what all tasks have in common with a robot, with an episode of one step.

    Raises:
        UnknownNameError: there is no such control mode or robot.
        TaskArgumentError: the robot does not have the control mode.
    """
    return EnvSpec(
        task=ANY_TASK,
        cameras=cameras(image_size_px),
        states=states(robot_named(robot).joints),
        action=action_of({ROBOT: robot, CONTROL_MODE: control_mode}),
        horizon_steps=1,
        control_hz=CONTROL_HZ,
        robot=robot,
    )
