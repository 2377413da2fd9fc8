"""From LeRobot's numbers of the motors to what policies take, and back. Knows nothing of devices.

`motors`: as they are. `pd_joint_pos`: rad of the joints of the arm's model, and a gripper in [-1, 1], as in
the simulator; that needs the zero of each joint, which no calibration of LeRobot's tells.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vla_eval.config.real_robot import SIMULATED_TYPE, JointZero, RobotSettings
from vla_eval.control_modes import JOINT_POS, MOTORS, POSITION
from vla_eval.core import FloatArray
from vla_eval.envs.robot.link import Motors
from vla_eval.errors import RecipeError, check_names
from vla_eval.oracles.chain import hand_pose
from vla_eval.robots.arm import Arm
from vla_eval.robots.rows import SO100
from vla_eval.specs import ActionSpec, StateSpec
from vla_eval.tasks.interface import states

ARMS = {SIMULATED_TYPE: SO100, "so100_follower": SO100, "so101_follower": SO100}
"""LeRobot's type -> the row of its arm. The SO-101 has the joints of the SO-100, in the same order."""
GRIPPER_OPEN = 100.0  # LeRobot's number of an open gripper; 0 is closed
UNLIMITED = 1e6  # where no limit is named: LeRobot's own calibration clips


@dataclass(frozen=True, slots=True, kw_only=True)
class Units:
    """What is offered of an arm."""

    motors: tuple[str, ...]
    low: Motors  # of each motor
    high: Motors
    mode: str
    arm: Arm | None  # None: only the motors are known
    zeros: tuple[JointZero, ...] = ()  # of the joints that move the hand

    @classmethod
    def of(cls, settings: RobotSettings, motors: tuple[str, ...]) -> Self:
        """Return the units of a robot with these motors.

        Raises:
            UnknownNameError: a limit or a zero is of a motor that it does not have.
            RecipeError: a zero is missing, or the robot has no row.
        """
        check_names("motor", settings.limits, motors, where="limits")
        check_names("motor", settings.home, motors, where="home")
        pairs = [settings.limits.get(name, (-UNLIMITED, UNLIMITED)) for name in motors]
        low, high = (np.array([pair[side] for pair in pairs]) for side in (0, 1))
        if settings.zeros is None:
            return cls(motors=motors, low=low, high=high, mode=settings.control_mode, arm=None)
        arm = ARMS.get(settings.type)
        if arm is None or arm.joints != motors:
            raise RecipeError(
                f"zeros: expected a robot with a row here ({', '.join(ARMS)}), found '{settings.type}' with "
                f"the motors {', '.join(motors)}. Leave `zeros` out, and use control_mode: motors."
            )
        joints = [arm.joints[index] for index in arm.arm_joints]
        check_names("joint", settings.zeros, joints, where="zeros")
        missing = [name for name in joints if name not in settings.zeros]
        if missing:
            raise RecipeError(f"zeros: {', '.join(missing)} missing; expected one of each of {joints}.")
        zeros = tuple(settings.zeros[name] for name in joints)
        return cls(motors=motors, low=low, high=high, mode=settings.control_mode, arm=arm, zeros=zeros)

    @property
    def action(self) -> ActionSpec:
        """What an action is."""
        if self.mode == JOINT_POS and self.arm is not None:
            return self.arm.actions[JOINT_POS]
        return ActionSpec(
            dims=self._fields,
            low=tuple(self.low.tolist()),
            high=tuple(self.high.tolist()),
            control_mode=MOTORS,
            gripper_open=None,
        )

    @property
    def _fields(self) -> tuple[str, ...]:
        """The motors, as LeRobot's datasets name their positions."""
        return tuple(f"{name}{POSITION}" for name in self.motors)

    @property
    def states(self) -> tuple[StateSpec, ...]:
        """What is offered of the arm's state."""
        own = StateSpec(name=MOTORS, dims=self._fields, unit="deg, gripper 0 to 100", frame="joint")
        return (own,) if self.arm is None else (*states(self.arm.joints), own)

    def state(self, motors: Motors, before: Motors, *, control_hz: float) -> dict[str, FloatArray]:
        """Return the states, float32; velocities are those since the reading one control step before."""
        found = {MOTORS: motors.astype(np.float32)}
        if self.arm is not None:
            qpos, previous = self._qpos(self.arm, motors), self._qpos(self.arm, before)
            found["qpos"] = qpos.astype(np.float32)
            found["qvel"] = ((qpos - previous) * control_hz).astype(np.float32)
            found["tcp_pose"] = _tcp_pose(self.arm, qpos)
        return found

    def goal(self, action: FloatArray) -> Motors:
        """Return where an action (A,) sends the motors, within their limits."""
        numbers = action.astype(np.float64)
        if self.mode == JOINT_POS:
            degrees = [
                one.sign * float(np.degrees(angle)) + one.zero_deg
                for one, angle in zip(self.zeros, numbers[:-1], strict=True)
            ]
            numbers = np.array([*degrees, (numbers[-1] + 1) / 2 * GRIPPER_OPEN])
        return np.clip(numbers, self.low, self.high)

    def action_of(self, motors: Motors) -> FloatArray:
        """Return the action (A,) that sends the motors to these positions."""
        if self.mode != JOINT_POS:
            return motors.astype(np.float32)
        gripper = np.clip(motors[-1] / GRIPPER_OPEN * 2 - 1, -1, 1)
        return np.array([*self._angles(motors), gripper], dtype=np.float32)

    def _angles(self, motors: Motors) -> list[float]:
        pairs = zip(self.zeros, motors[:-1].tolist(), strict=True)
        return [float(np.radians(one.sign * (degrees - one.zero_deg))) for one, degrees in pairs]

    def _qpos(self, arm: Arm, motors: Motors) -> NDArray[np.float64]:
        share, jaw = motors[-1] / GRIPPER_OPEN, arm.gripper
        return np.array([*self._angles(motors), jaw.closed + share * (jaw.opened - jaw.closed)])


def _tcp_pose(arm: Arm, qpos: NDArray[np.float64]) -> FloatArray:
    """Return the (7,) pose of the tool centre point, m and wxyz, by the arm's model; world frame."""
    tool = hand_pose(arm, qpos[list(arm.arm_joints)]).tool
    wxyz = Rotation.from_matrix(tool[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return np.array([*tool[:3, 3], *wxyz], dtype=np.float32)
