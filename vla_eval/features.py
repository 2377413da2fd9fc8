"""What a frame of a demonstration holds: names, shapes, dimensions, and how it is computed.

Numpy only: it knows nothing of lerobot, which is handed `dataset_features()` as plain data, nor of
simulators, whose observation it takes as `core.Observation`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE, MOTORS
from vla_eval.core import FloatArray, Observation, StepResult
from vla_eval.errors import SpecMismatchError
from vla_eval.robots.arm import Arm
from vla_eval.robots.rows import PANDA
from vla_eval.specs import EnvSpec
from vla_eval.strict.bounds import Bounds, Steps, check_bounds

MAX_CRF = 63  # of AV1; H.264 takes up to 51
FPS = 20  # control steps per second; every frame is one control step

CAMERA_KEYS = {"base_camera": "observation.images.base", "hand_camera": "observation.images.wrist"}
"""Camera of the environment -> field of the dataset."""
CAMERA_PREFIX = "observation.images."  # LeRobot's, of any camera
IMAGE_SIZE_PX = 128  # height and width of images for which nothing else is said
IMAGE_SHAPE = (IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3)  # height, width, channels

STATE_KEY = "observation.state"
ACTION_KEY = "action"
ACTION_PADDING_KEY = f"{ACTION_KEY}_is_pad"  # in training samples: which lie beyond the end
REWARD_KEY, SUCCESS_KEY, DONE_KEY = "next.reward", "next.success", "next.done"
RewardKind = Literal["dense", "sparse", "success"]
"""Which rewards a policy is trained on: the table's, or 1 at the first success of an episode and else 0, or 1
in every step at which the success rule holds."""

StateKind = Literal["eef", "joints"]
PROPRIO_KEYS: dict[StateKind, str] = {"eef": "proprio.eef", "joints": "proprio.joints"}
"""Both kinds are always stored. lerobot takes as inputs only what begins with `observation`."""
PROPRIO_STATES = ("tcp_pose", "qpos", "qvel")
"""States of the environment that both are computed from; `joints` is all of them, one after the other."""


def camera_key(camera: str) -> str:
    """Return the field of a camera: of the table, else as LeRobot names it."""
    return CAMERA_KEYS.get(camera, f"{CAMERA_PREFIX}{camera}")


POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
JOINT_NAMES = PANDA.joints  # of the default robot, as all that names no other
ACTION_NAMES = CONTROL_MODES[EE_DELTA_POSE].dims


def state_names(arm: Arm) -> dict[StateKind, tuple[str, ...]]:
    """Return kind -> the names of its numbers with a robot."""
    return {
        # The first two columns of the rotation matrix: no jumps, unlike roll-pitch-yaw, whose roll sits at
        # ±π for a gripper that points down, and unlike a quaternion, which may flip its sign.
        "eef": ("x", "y", "z", "r11", "r21", "r31", "r12", "r22", "r32", "gripper_width"),
        # The paper's 25 numbers: pose of the tool centre point, joint positions, joint velocities.
        "joints": (*POSE_NAMES, *arm.joints, *(f"{name}_velocity" for name in arm.joints)),
    }


STATE_NAMES = state_names(PANDA)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderSettings:
    """How frames become video. Defaults keep colours: no chroma subsampling, about 40 dB."""

    vcodec: str = "h264"  # codec as lerobot names it
    # `yuv444p` keeps the colour of every pixel; `yuv420p` caps quality at about 34 dB
    pix_fmt: str = "yuv444p"
    crf: Annotated[int, Bounds(0, MAX_CRF)] = 12  # quality; lower is better and larger
    g: Steps = 2  # a key frame every so many frames; small, since training reads frames at random

    def __post_init__(self) -> None:
        """Check the ranges; whether the codec knows the format is lerobot's to say."""
        check_bounds(self, prefix="encoder.")


def dataset_features(
    state: StateKind,
    *,
    action_names: tuple[str, ...] = ACTION_NAMES,
    image_size_px: int = IMAGE_SIZE_PX,
    arm: Arm = PANDA,
) -> dict[str, dict[str, Any]]:  # Any: lerobot's plain data
    """Return the fields of a dataset as `LeRobotDataset.create(features=…)` takes them."""
    names = state_names(arm)

    def vector(names: tuple[str, ...]) -> dict[str, Any]:  # Any: as above
        return {"dtype": "float32", "shape": (len(names),), "names": list(names)}

    def scalar(dtype: str, name: str) -> dict[str, Any]:  # Any: as above
        return {"dtype": dtype, "shape": (1,), "names": [name]}

    return {
        **{key: _video(image_size_px, image_size_px) for key in CAMERA_KEYS.values()},
        STATE_KEY: vector(names[state]),
        ACTION_KEY: vector(action_names),
        **{key: vector(names[kind]) for kind, key in PROPRIO_KEYS.items()},
        REWARD_KEY: scalar("float32", "reward"),
        SUCCESS_KEY: scalar("bool", "success"),
        DONE_KEY: scalar("bool", "done"),
    }


def arm_features(env: EnvSpec) -> dict[str, dict[str, Any]]:  # Any: lerobot's plain data
    """Return the fields of demonstrations on an arm that LeRobot drives: its motors, and all its cameras."""
    motors = {"dtype": "float32", "shape": (len(env.action.dims),), "names": list(env.action.dims)}
    flags = {SUCCESS_KEY: "success", DONE_KEY: "done"}
    return {
        **{camera_key(one.name): _video(one.height_px, one.width_px) for one in env.cameras},
        STATE_KEY: motors,
        ACTION_KEY: dict(motors),
        **{key: {"dtype": "bool", "shape": (1,), "names": [name]} for key, name in flags.items()},
    }


def arm_frame(
    before: Observation, *, action: FloatArray, is_success: bool, is_last: bool
) -> dict[str, Any]:  # Any: arrays of several types
    """Return one frame of such a demonstration, as `LeRobotDataset.add_frame` takes it, without the task.

    `action` (M,) is where the motors were sent, and `is_success` whether the success rule holds after it.
    """
    return {
        **{camera_key(camera): image for camera, image in before.images.items()},
        STATE_KEY: before.state[MOTORS],
        ACTION_KEY: action.astype(np.float32),
        SUCCESS_KEY: np.array([is_success]),
        DONE_KEY: np.array([is_last]),
    }


def _video(height_px: int, width_px: int) -> dict[str, Any]:  # Any: lerobot's plain data
    shape = (height_px, width_px, 3)
    return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}


def proprioception(state: Mapping[str, FloatArray], arm: Arm = PANDA) -> dict[StateKind, FloatArray]:
    """Return both kinds of proprioception of an observation, float32: `eef` (10,), `joints` (7 + 2 J,).

    `tcp_pose` (7,) is position in m and wxyz quaternion, world frame; see `state_names`.

    Raises:
        SpecMismatchError: the observation is of another robot.
    """
    pose, qpos, qvel = state["tcp_pose"], state["qpos"], state["qvel"]
    if len(qpos) != len(arm.joints):
        raise SpecMismatchError(
            f"proprioception: expected the {len(arm.joints)} joints of the robot {arm.name}, found "
            f"{len(qpos)}. Use the robot of the dataset or of the policy: env.robot={arm.name}."
        )
    columns = rotation_columns(pose[3:])
    width_m = arm.gripper.width_m(qpos)[None]
    return {
        "eef": np.concatenate([pose[:3], columns, width_m]).astype(np.float32),
        "joints": np.concatenate([pose, qpos, qvel]).astype(np.float32),
    }


def rotation_columns(quaternion_wxyz: FloatArray) -> FloatArray:
    """Return (6,): the first two columns of the rotation matrix, one after the other.

    Source: Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks".
    """
    w, x, y, z = quaternion_wxyz.astype(np.float64) / np.linalg.norm(quaternion_wxyz.astype(np.float64))
    first = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    second = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    return np.array([*first, *second], dtype=np.float32)


def frame_values(
    before: StepResult,
    after: StepResult,
    *,
    action: FloatArray,
    state: StateKind,
    is_last: bool,
    arm: Arm = PANDA,
) -> dict[str, Any]:  # Any: arrays of several types
    """Return one frame as `LeRobotDataset.add_frame` takes it, without the task string.

    `before` has images of all cameras, `action` (A,) is what is stored and `after` what it led to.
    """
    kinds = proprioception(before.observation.state, arm)
    return {
        **{key: before.observation.images[camera] for camera, key in CAMERA_KEYS.items()},
        STATE_KEY: kinds[state],
        ACTION_KEY: action.astype(np.float32),
        **{key: kinds[kind] for kind, key in PROPRIO_KEYS.items()},
        REWARD_KEY: np.array([after.reward], dtype=np.float32),
        SUCCESS_KEY: np.array([after.status.success]),
        DONE_KEY: np.array([is_last]),
    }
