"""What a row says of a robot: an arm with a gripper that stands still at the table."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.specs import ActionSpec

Numbers = NDArray[np.floating[Any]]
Xyz = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gripper:
    """Which joints move the fingers, and how far these are then apart."""

    joints: tuple[int, ...] = (-2, -1)  # indices of `qpos`
    closed: float  # their position at the action -1, rad, or m for prismatic joints
    opened: float  # and at the action 1
    # (position, gap between the fingertips in m) in ascending order, in between by straight lines; empty:
    # the joints are prismatic, and the gap is the sum of their positions
    gaps_m: tuple[tuple[float, float], ...] = ()

    def width_m(self, qpos: Numbers) -> Numbers:
        """Return the gap between the fingers of joint positions (…, J), as (…)."""
        position = self.position(qpos)
        if not self.gaps_m:
            return position * len(self.joints)
        positions, gaps_m = zip(*self.gaps_m, strict=True)
        return np.asarray(np.interp(position, positions, gaps_m), dtype=qpos.dtype)

    def position(self, qpos: Numbers) -> Numbers:
        """Return the mean position of the fingers' joints (…), rad or m, of joint positions (…, J)."""
        total = qpos[..., self.joints[0]]
        for joint in self.joints[1:]:
            total = total + qpos[..., joint]
        return np.asarray(total / len(self.joints))

    def command(self, width_m: float) -> float:
        """Return the last number of an action, in [-1, 1], that brings the fingers this far apart."""
        if self.gaps_m:
            positions, gaps_m = zip(*sorted(self.gaps_m, key=lambda pair: pair[1]), strict=True)
            position = float(np.interp(width_m, gaps_m, positions))
        else:
            position = width_m / len(self.joints)
        share = (position - self.closed) / (self.opened - self.closed)
        return float(np.clip(share * 2 - 1, -1, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Hinge:
    """A joint of a chain as a URDF describes it, in the frame of the one before."""

    origin_m: Xyz
    rpy_rad: Xyz = (0.0, 0.0, 0.0)
    axis: Xyz


@dataclass(frozen=True, slots=True, kw_only=True)
class Chain:
    """The joints from the root to the hand, and the tool centre point at its end.

    The tool's z points along the fingers, its y from one to the other.
    """

    hinges: tuple[Hinge, ...]
    tool: Hinge  # fixed: its axis is not used
    low_rad: tuple[float, ...]
    high_rad: tuple[float, ...]
    least_reach_m: float  # nearer to the first hinge's axis, which is vertical, the hand has to turn about it


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """A robot at the table."""

    name: str  # value of `env.robot`
    # `module:Class` of its ManiSkill agent: importing the module registers it
    agent: str
    # names of the agent and its variants in ManiSkill, values of `robot_uids`; the first is the usual one
    uids: tuple[str, ...]
    description: str  # one line
    joints: tuple[str, ...]  # names of the entries of `qpos`
    arm_joints: tuple[int, ...]  # indices of those that move the hand
    gripper: Gripper
    # joint positions at the start of an episode, without noise; rad, and m for prismatic joints
    rest_qpos: tuple[float, ...]
    base_m: Xyz  # position of the root, world frame
    base_yaw_rad: float = 0.0  # and how far it is turned about the vertical
    # where the tool centre point is, for an agent of ManiSkill that has none; its axes are those of `Chain`
    tool: Hinge | None = None
    asset: str = ""  # ManiSkill's name of the download that has its meshes; empty: they are in its wheel
    # control mode -> what an action is; the first is the one of an environment for which none is named
    actions: Mapping[str, ActionSpec]
    # for an arm without a control mode of the hand's pose: what scripted controls need to move its joints
    chain: Chain | None = None
    # family of tasks -> why the arm does not solve it, in words: it is not offered there
    not_solved: Mapping[str, str] = field(default_factory=dict)

    @property
    def added_tool(self) -> Hinge:
        """The tool centre point of an arm for which ManiSkill's agent has none."""
        tool = self.tool if self.chain is None else self.chain.tool
        assert tool is not None, f"{self.name}: the agent has a tool centre point of its own"
        return tool
