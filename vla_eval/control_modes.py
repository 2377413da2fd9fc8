"""What an action means: control modes, their numbers and bounds; the Panda's. Knows nothing of simulators.

Names, order and bounds are those of ManiSkill's controllers. The last number is the gripper in every mode:
1 opens it, -1 closes it, and what is between is a width.

Source: https://github.com/haosulab/ManiSkill/blob/628bbe64e2c925d9d543171361a86c4a4965c6e9/mani_skill/agents/robots/panda/panda.py
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from vla_eval.errors import unknown_name
from vla_eval.specs import ActionSpec

CONTROL_MODE = "control_mode"
"""Name of the argument in `env` that chooses one."""
EE_DELTA_POSE = "pd_ee_delta_pose"
"""The mode of an environment with the Panda for which none is named."""
EE_DELTA_POS, EE_POSE = "pd_ee_delta_pos", "pd_ee_pose"
JOINT_DELTA_POS, JOINT_POS = "pd_joint_delta_pos", "pd_joint_pos"
MOTORS: Final = "motors"
"""A real arm's own numbers, as LeRobot has them; no simulator executes them. Also the state that they are."""
POSITION = ".pos"
"""LeRobot's ending of the name of a motor's position."""
ABSOLUTE_MODES = (JOINT_POS, EE_POSE)
"""Their actions are where the arm is to be, not how far it is to move."""

TRANSLATING_MODES = (EE_DELTA_POSE, EE_DELTA_POS)
"""Their actions begin with how far the tool is to move."""

DELTA_M, DELTA_RAD = 0.1, 0.1
"""What 1 means in a delta mode. ManiSkill multiplies rotations by their lower bound, so their sign is
inverted."""
N_ARM_JOINTS = 7
ARM_JOINTS = tuple(f"joint{i}" for i in range(1, N_ARM_JOINTS + 1))
# Of `panda_v3.urdf`; rad.
JOINT_LOW_RAD = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
JOINT_HIGH_RAD = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
POSE_BOUND_M, POSE_BOUND_RAD = 2.0, 2 * np.pi


def _spec(mode: str, dims: tuple[str, ...], low: tuple[float, ...], high: tuple[float, ...]) -> ActionSpec:
    """Return a mode's spec, with the gripper as its last number and bounds that float32 can hold."""
    return ActionSpec(
        dims=(*dims, "gripper"),
        low=tuple(float(np.float32(bound)) for bound in (*low, -1.0)),
        high=tuple(float(np.float32(bound)) for bound in (*high, 1.0)),
        control_mode=mode,
        gripper_open=1.0,
    )


def _delta(mode: str, dims: tuple[str, ...]) -> ActionSpec:
    return _spec(mode, dims, (-1.0,) * len(dims), (1.0,) * len(dims))


def joint_modes(
    joints: tuple[str, ...], low_rad: tuple[float, ...], high_rad: tuple[float, ...]
) -> tuple[ActionSpec, ActionSpec]:
    """Return what an action is in `pd_joint_delta_pos` and in `pd_joint_pos` of an arm with these joints."""
    moved = tuple(f"{name}_delta" for name in joints)
    return _delta(JOINT_DELTA_POS, moved), _spec(JOINT_POS, joints, low_rad, high_rad)


_POSE_BOUNDS = (*(POSE_BOUND_M,) * 3, *(POSE_BOUND_RAD,) * 3)

CONTROL_MODES: Mapping[str, ActionSpec] = MappingProxyType(
    {
        spec.control_mode: spec
        for spec in (
            _delta(EE_DELTA_POSE, ("dx", "dy", "dz", "drx", "dry", "drz")),
            _delta(EE_DELTA_POS, ("dx", "dy", "dz")),
            *joint_modes(ARM_JOINTS, JOINT_LOW_RAD, JOINT_HIGH_RAD),
            _spec(
                EE_POSE,
                ("x", "y", "z", "rx", "ry", "rz"),
                tuple(-bound for bound in _POSE_BOUNDS),
                _POSE_BOUNDS,
            ),
        )
    }
)
"""Mode -> its action with the Panda. Positions in m and rotations in rad (XYZ Euler angles) in the frame of
the base."""

RELATIVE_MODES = (EE_DELTA_POSE, EE_DELTA_POS, JOINT_DELTA_POS)
"""Modes whose actions are motions from where the arm is: one that is skipped is lost."""


def action_spec(mode: str) -> ActionSpec:
    """Return what an action of a mode is."""
    if mode not in CONTROL_MODES:
        raise unknown_name("control mode", mode, CONTROL_MODES, where=f"env.{CONTROL_MODE}")
    return CONTROL_MODES[mode]
