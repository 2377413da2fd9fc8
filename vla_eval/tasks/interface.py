"""What every task offers to a policy with the Panda: cameras, states, action, control rate.

Knows nothing of simulators: a server of policies has none.
"""

import numpy as np

from vla_eval.features import ACTION_NAMES, JOINT_NAMES, POSE_NAMES
from vla_eval.specs import ActionSpec, CameraSpec, EnvSpec, StateSpec
from vla_eval.tasks.spec import TaskSpec

CAMERA_SIZE_PX = 128
CAMERA_FOV_RAD = np.pi / 2
CONTROL_MODE = "pd_ee_delta_pose"
CONTROL_HZ = 20.0
CAMERAS = tuple(
    CameraSpec(name=name, height_px=CAMERA_SIZE_PX, width_px=CAMERA_SIZE_PX, fov_rad=CAMERA_FOV_RAD)
    for name in ("base_camera", "hand_camera")
)
ACTION = ActionSpec(dims=ACTION_NAMES, low=-1.0, high=1.0, control_mode=CONTROL_MODE, gripper_open=1.0)
ANY_TASK = "any task"
"""Stands for the task's id where a policy is made for none in particular."""


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


def env_spec(task: TaskSpec | None = None) -> EnvSpec:
    """Return what a task offers with the Panda, without making its environment.

    Args:
        task: its row in the catalogue; None: what all tasks have in common, with an episode of one step.
    """
    return EnvSpec(
        task=ANY_TASK if task is None else task.id,
        cameras=CAMERAS,
        states=states(),
        action=ACTION,
        horizon_steps=1 if task is None else task.default_horizon_steps(0),
        control_hz=CONTROL_HZ,
    )
