"""What leads an arm: LeRobot's own SO-101 leader with a bus in memory, and what is refused of others."""

from typing import Any

import lerobot.teleoperators.so_leader.so_leader as leader
import numpy as np
import pytest

from tests.envs.robot_station import Bench
from tests.envs.test_lerobot_follower import BusInMemory
from tests.envs.test_lerobot_follower import arm as arm
from tests.real.recording_bench import FakeLeader
from vla_eval.envs.robot.link import RobotLink
from vla_eval.envs.robot.opening import open_teleop
from vla_eval.envs.robot.teleop import TeleopLink
from vla_eval.errors import RecipeError, RobotBusError, RobotError, UnknownNameError

LEADER = {"type": "so101_leader", "port": "/dev/nothing", "id": "test"}


@pytest.fixture
def teleop(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Any:
    monkeypatch.setattr(leader, "FeetechMotorsBus", BusInMemory)
    monkeypatch.setattr(leader.SOLeader, "configure", lambda self: None)  # registers of the servos
    monkeypatch.setattr(BusInMemory, "disconnect", lambda self, *_: setattr(self, "is_connected", False))
    return open_teleop({**LEADER, "calibration_dir": str(tmp_path)})


def test_an_so101_leads_an_so101(teleop: Any, arm: Any) -> None:
    link = TeleopLink(teleop, RobotLink(arm))
    link.connect()
    teleop.bus.positions["elbow_flex"] = -33.0
    assert dict(zip(link.motors, link.read().tolist(), strict=True)) == {
        **dict.fromkeys(arm.bus.motors, 20.0),
        "elbow_flex": -33.0,
    }
    link.disconnect()
    with pytest.raises(RobotBusError, match=r"teleoperator '\w+', reading"):
        link.read()


def test_without_a_calibration_it_is_refused(teleop: Any, arm: Any) -> None:
    teleop.bus.is_calibrated = False
    with pytest.raises(RobotBusError, match="not calibrated"):
        TeleopLink(teleop, RobotLink(arm)).connect()


def test_other_units_than_the_arms_are_refused(teleop: Any, arm: Any) -> None:
    teleop.config.use_degrees = False
    with pytest.raises(RecipeError, match=r"teleop.use_degrees is False and lerobot.use_degrees True"):
        TeleopLink(teleop, RobotLink(arm))


def test_other_motors_than_the_arms_are_refused(arm: Any) -> None:
    with pytest.raises(RobotError, match=r"elbow_flex.pos.*found gripper.pos, lift.pos, pan.pos"):
        TeleopLink(FakeLeader(0, 0, 0), RobotLink(arm))


@pytest.mark.parametrize("value", [None, np.nan, np.inf])
def test_a_position_that_is_none_is_an_error(value: Any) -> None:
    bench, fake = Bench(), FakeLeader(1, 2, 3)
    fake.positions[1] = value
    with pytest.raises(RobotBusError, match="motor 'lift', found"):
        TeleopLink(fake, bench.link).read()


def test_mistyped_types_and_fields_are_said() -> None:
    with pytest.raises(UnknownNameError, match=r"teleop\.type.*Did you mean 'so101_leader'"):
        open_teleop({**LEADER, "type": "so101_leder"})
    with pytest.raises(RecipeError, match=r"teleop: LeRobot does not take .*prot"):
        open_teleop({**LEADER, "prot": "x"})
