"""LeRobot's own SO follower, with a bus in memory in place of the servos: names, order, calibration."""

from typing import Any

import lerobot.robots.so_follower.so_follower as follower
import numpy as np
import pytest

from tests.envs.robot_station import FakeOperator
from vla_eval.config.real_robot import RobotSettings
from vla_eval.envs.robot.link import RobotLink
from vla_eval.envs.robot.opening import open_robot
from vla_eval.envs.robot.robot_env import RobotEnv, Station
from vla_eval.envs.robot.watch import StepClock
from vla_eval.errors import RecipeError, RobotBusError, UnknownNameError
from vla_eval.robots.rows import SO100
from vla_eval.tasks.real_stages import STAGES, Trial

FIELDS = {"type": "so101_follower", "port": "/dev/nothing", "id": "test"}


class BusInMemory:
    """Servos that go where they are sent, in the calls that LeRobot's follower makes."""

    def __init__(self, *, port: str, motors: dict[str, Any], calibration: dict[str, Any]) -> None:
        self.motors, self.positions = motors, dict.fromkeys(motors, 20.0)
        self.is_connected, self.is_calibrated, self.n_written = False, True, 0

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self, disable_torque: bool) -> None:
        self.is_connected = False

    def sync_read(self, register: str, *, num_retry: int) -> dict[str, float]:
        assert register == "Present_Position"
        return dict(self.positions)

    def sync_write(self, register: str, goals: dict[str, float]) -> None:
        assert register == "Goal_Position" and goals.keys() == self.positions.keys()
        self.positions, self.n_written = dict(goals), self.n_written + 1


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Any:
    monkeypatch.setattr(follower, "FeetechMotorsBus", BusInMemory)
    monkeypatch.setattr(follower.SOFollower, "configure", lambda self: None)  # registers of the servos
    return open_robot(RobotSettings(lerobot={**FIELDS, "calibration_dir": str(tmp_path)}))


def test_it_is_driven_as_an_environment(arm: Any) -> None:
    settings = RobotSettings(lerobot=FIELDS, max_step=4.0, response_seconds=1.0)
    link = RobotLink(arm)
    assert link.motors == SO100.joints  # the SO-101 has those of the row, in the same order
    link.connect()
    station = Station.beside(link, FakeOperator(), settings, StepClock())
    trial = Trial(number=1, seed=0, stage=STAGES[0], color=0, places=(0, 1, 2))
    env = RobotEnv(station, STAGES[0], {0: trial})
    assert (env.spec.task, env.spec.robot) == ("real/CubeVisible-v0", None)
    began = env.reset({0: 0}, render=True)[0]
    assert began.observation.state["motors"].tolist() == [20.0] * 6 and arm.bus.n_written == 0
    action = np.array([90, -90, 20, 21, 20, 100], dtype=np.float32)
    then = env.step({0: action}, render=frozenset({0}))[0]
    assert then.observation.state["motors"].tolist() == [24.0, 16.0, 20.0, 21.0, 20.0, 24.0]


def test_without_a_calibration_it_is_refused_before_it_asks_for_one(arm: Any) -> None:
    arm.bus.is_calibrated = False
    with pytest.raises(RobotBusError, match="not calibrated"):
        RobotLink(arm).connect()


def test_mistyped_types_and_fields_are_said() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'so101_follower'"):
        open_robot(RobotSettings(lerobot={**FIELDS, "type": "so101_folower"}))
    with pytest.raises(RecipeError, match="prot"):
        open_robot(RobotSettings(lerobot={**FIELDS, "prot": "x"}))
