"""Proprioception as servers want it: a layout below, or names of states with `+` between them."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from vla_eval.core import FloatArray
from vla_eval.errors import SpecMismatchError, did_you_mean
from vla_eval.features import STATE_NAMES, proprioception
from vla_eval.specs import EnvSpec

POSE, JOINTS, VELOCITIES = "tcp_pose", "qpos", "qvel"
N_ARM_JOINTS, N_JOINTS = 7, 9  # of the Panda; the last two are its fingers
MAX_WIDTH_M = 0.08  # between the Panda's fingers


class StateLayout(NamedTuple):
    """The environment's states that it is computed from, its length, and how: to (n_numbers,) float32."""

    states: tuple[str, ...]
    n_numbers: int
    compute: Callable[[Mapping[str, FloatArray]], FloatArray]


def state_layout(name: str, env: EnvSpec, *, where: str) -> StateLayout:
    """Return a layout by its name, `joints` or `tcp_pose+qpos`; refuse one that the environment lacks."""
    offered = {state.name: len(state.dims) for state in env.states}
    found = LAYOUTS.get(name)
    if found is None:
        parts = tuple(name.split("+"))
        unknown = [part for part in parts if part not in offered]
        if unknown:
            raise SpecMismatchError(
                f"{where}: there is no state layout '{name:.80}'.{did_you_mean(name, [*LAYOUTS, *offered])} "
                f"Known: {', '.join(LAYOUTS)}; or states of {env.task} with '+' between them: "
                f"{', '.join(offered)}."
            )
        return StateLayout(
            parts,
            sum(offered[part] for part in parts),
            lambda state: np.concatenate([state[part] for part in parts]).astype(np.float32),
        )
    if offered.get(JOINTS) != N_JOINTS or any(part not in offered for part in found.states):
        raise SpecMismatchError(
            f"{where}: the state layout '{name}' is the Panda's, with {N_JOINTS} joints and "
            f"{', '.join(found.states)}; {env.task} has {offered.get(JOINTS, 0)} joints and "
            f"{', '.join(offered)}. Leave env.robot_uids out."
        )
    return found


def layout_names(name: str) -> tuple[str, ...] | None:
    """Return the names of a layout's numbers; None where only their count is fixed."""
    return STATE_NAMES["joints" if name == "joints" else "eef"] if name in ("joints", "eef") else None


def axis_angle(quaternion_wxyz: FloatArray) -> FloatArray:
    """Return a rotation as its axis times its angle in [0, 2π), (3,) float32.

    The angle is not made the shorter one, as openpi's client for LIBERO does not:
    https://github.com/Physical-Intelligence/openpi/blob/15a9616a00943ada6c20a0f158e3adb39df2ccac/examples/libero/main.py
    """
    w, *axis = quaternion_wxyz.astype(np.float64) / np.linalg.norm(quaternion_wxyz.astype(np.float64))
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:  # no rotation has no axis
        return np.zeros(3, dtype=np.float32)
    rotation_vector = np.asarray(axis) / sine * 2.0 * np.arctan2(sine, w)
    return np.asarray(rotation_vector, dtype=np.float32)


def _libero(state: Mapping[str, FloatArray]) -> FloatArray:
    pose, joints = state[POSE], state[JOINTS]
    # The second finger's joint has the other sign at robosuite's Panda.
    fingers = np.array([joints[-2], -joints[-1]])
    vector: FloatArray = np.concatenate([pose[:3], axis_angle(pose[3:]), fingers]).astype(np.float32)
    return vector


def _closedness(state: Mapping[str, FloatArray]) -> FloatArray:
    width_m = float(state[JOINTS][-2:].sum())
    opened = min(max(width_m / MAX_WIDTH_M, 0.0), 1.0)
    return np.array([1.0 - opened], dtype=np.float32)


LAYOUTS: Mapping[str, StateLayout] = {
    # The paper's 25 numbers, and the 10 of the kind `eef`: see `features.STATE_NAMES`.
    "joints": StateLayout((POSE, JOINTS, VELOCITIES), 25, lambda state: proprioception(state)["joints"]),
    "eef": StateLayout((POSE, JOINTS, VELOCITIES), 10, lambda state: proprioception(state)["eef"]),
    # Position, axis-angle, two finger joints of opposite signs. Sources: openpi's client (above);
    # https://github.com/ARISE-Initiative/robosuite/blob/
    # 8afb646610c50346405bd6c1cf23e528a7b43636/robosuite/models/grippers/panda_gripper.py
    "libero": StateLayout((POSE, JOINTS), 8, _libero),
    "joint_positions": StateLayout(
        (JOINTS,), N_ARM_JOINTS, lambda state: state[JOINTS][:N_ARM_JOINTS].astype(np.float32)
    ),
    # 0 open, 1 closed, as DROID's `gripper_position`. Source:
    # https://github.com/droid-dataset/droid/blob/c43ab6b02b69c5bd1678cd62af3881bd18f27067/droid/franka/robot.py
    "gripper_closedness": StateLayout((JOINTS,), 1, _closedness),
}
