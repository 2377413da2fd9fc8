"""A robot arm for `mikasa-vla real`: LeRobot's fields of it, and the limits within which it may move."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from vla_eval.config.files import to_data
from vla_eval.control_modes import MOTORS
from vla_eval.errors import RecipeError, unknown_name
from vla_eval.strict.bounds import Bounds, check_bounds, require
from vla_eval.strict.decoding import decode, load_yaml

SIMULATED_TYPE = "simulated_so100"
"""LeRobot's type of the simulated arm, and its name on the command line."""
SIMULATED_HZ = 20.0  # of every task
RealControlMode = Literal["motors", "pd_joint_pos"]
REAL_CONTROL_MODES: tuple[RealControlMode, ...] = get_args(RealControlMode)
TYPE = "type"
ADDRESSES = ("port", "index_or_path", "serial_number_or_name")
"""LeRobot's fields that say where a device is found today."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointZero:
    """How a motor's degrees become the angle of the arm's model: angle = sign * (motor - zero_deg)."""

    sign: Literal[-1, 1]
    zero_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSettings:
    """What a robot is, and how it is driven. Numbers of motors are LeRobot's: degrees, grippers 0 to 100."""

    # LeRobot's configuration: `type`, `port`, `cameras` …
    lerobot: dict[str, Any]  # Any: plain data, which LeRobot checks
    # LeRobot's configuration of what leads the arm in a demonstration: `type`, `port` …; no policy needs one
    teleop: dict[str, Any] | None = None  # Any: as above
    control_hz: Annotated[float, Bounds(1, 200)] = 30.0
    # what an action is: `motors`, or `pd_joint_pos`, as policies that were trained in the simulator give it
    control_mode: RealControlMode = "motors"
    # how far from its present position a motor may be sent in one control step
    max_step: Annotated[float, Bounds(0.1, 90)] = 10.0
    # motor -> (lowest, highest) position; a motor that is not named: LeRobot's own range alone
    limits: dict[str, tuple[float, ...]] = field(default_factory=dict)
    # of an arm that has a row here: joint -> its zero; without it, only `motors` is known about the arm
    zeros: dict[str, JointZero] | None = None
    # motor -> where it is when an episode begins; one that is not named: where it was when the session began
    home: dict[str, float] = field(default_factory=dict)
    response_seconds: Annotated[float, Bounds(0.1, 3600)] = 30.0  # for the answer; then the episode ends
    # for the operator, for each of his answers; then the episode is an error
    operator_seconds: Annotated[float, Bounds(1, 3600)] = 300.0
    # the arm stops so long after the last sign of life of the dead man's key
    dead_man_seconds: Annotated[float, Bounds(0.1, 10)] = 1.5
    stale_frames: Annotated[int, Bounds(2, 1000)] = (
        10  # so many identical images in a row: the camera is frozen
    )
    # the longest time between two commands, an inference included
    max_gap_seconds: Annotated[float, Bounds(0.01, 60)] = 2.0

    def __post_init__(self) -> None:
        check_bounds(self)
        devices = (("lerobot", self.lerobot, "so101_follower"), ("teleop", self.teleop, "so101_leader"))
        for name, fields, example in devices:
            kind = "" if fields is None else fields.get(TYPE)
            require(isinstance(kind, str), f"{name}.type", repr(kind), f"LeRobot's type, such as {example}")
        for motor, pair in self.limits.items():
            sound = len(pair) == 2 and pair[0] < pair[1]
            require(sound, f"limits.{motor}", str(list(pair)), "two numbers, the lower one first")
        at_its_rate = not self.is_simulated or self.control_hz == SIMULATED_HZ
        require(at_its_rate, "control_hz", f"{self.control_hz:g}", f"{SIMULATED_HZ:g} of {SIMULATED_TYPE}")
        if self.control_mode != MOTORS and self.zeros is None:
            raise RecipeError(
                f"control_mode is {self.control_mode}, and `zeros` is missing: angles of the arm's model are "
                "known only with the zero of each joint. Measure them, or use control_mode: motors."
            )

    @property
    def type(self) -> str:
        """LeRobot's type of the robot."""
        return str(self.lerobot[TYPE])

    @property
    def is_simulated(self) -> bool:
        """Whether it is the simulated arm."""
        return self.type == SIMULATED_TYPE

    @property
    def content(self) -> dict[str, Any]:  # Any: plain data
        """All that a policy's results depend on: no address of a device, and not what leads the arm."""
        fields = {**to_data(self), "lerobot": _without_addresses(self.lerobot)}
        return {name: value for name, value in fields.items() if name != "teleop"}

    @property
    def teleop_content(self) -> dict[str, Any]:  # Any: plain data
        """The fields of what leads the arm, without addresses; empty without one."""
        return _without_addresses(self.teleop or {})


def _without_addresses(fields: Mapping[str, Any]) -> dict[str, Any]:  # Any: plain data
    return {
        name: _without_addresses(value) if isinstance(value, Mapping) else value
        for name, value in fields.items()
        if name not in ADDRESSES
    }


SIMULATED = RobotSettings(
    lerobot={TYPE: SIMULATED_TYPE},
    control_hz=SIMULATED_HZ,
    control_mode="pd_joint_pos",
    max_step=30.0,
    zeros={
        joint: JointZero(sign=1, zero_deg=0.0)
        for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    },
    response_seconds=8.0,
    operator_seconds=10.0,
)
"""The simulated arm: its motors' degrees are the angles of its model."""


def load_robot(name: str) -> RobotSettings:
    """Return the simulated arm by its name, or what a YAML file says.

    Raises:
        UnknownNameError: there is no such file.
        RecipeError: it cannot be read, or a value is not allowed.
    """
    if name == SIMULATED_TYPE:
        return SIMULATED
    path = Path(name)
    if path.suffix not in (".yaml", ".yml") or not os.path.isfile(path):
        raise unknown_name("robot", name, [SIMULATED_TYPE, "FILE.yaml (docs/real_robot.md)"], where="--robot")
    try:
        data = load_yaml(path.read_text(encoding="utf-8"), where=name)
    except (OSError, UnicodeDecodeError) as exc:
        raise RecipeError(f"{name}: cannot be read as a text file in UTF-8 ({exc}).") from exc
    if not isinstance(data, dict):
        raise RecipeError(f"{name}: expected fields with values (`lerobot: …`), found {data!r:.60}.")
    return decode(RobotSettings, data, where=name)
