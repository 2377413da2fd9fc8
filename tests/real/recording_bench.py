"""A recording without hardware: the arm of `robot_station`, a leader in memory, a person who presses keys."""

import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import Any

from tests.envs.robot_station import JOINTS, Bench, FakeOperator
from vla_eval.config.real_robot import RobotSettings
from vla_eval.control_modes import MOTORS
from vla_eval.envs.robot.robot_env import Station
from vla_eval.envs.robot.teleop import TeleopLink
from vla_eval.real.demonstrations import Demonstrations
from vla_eval.real.leaders import BesideLeader, TeleopLeader
from vla_eval.real.recording import RecordedStages, RecordingSession
from vla_eval.tasks.real_stages import Trial, stage_of

ANSWER_STEPS = 3  # control steps from the response's beginning to the last mark


class FakeLeader:
    """LeRobot's teleoperator, as far as it is called: always at the same place."""

    name = "fake_leader"

    def __init__(self, *positions: float) -> None:
        self.action_features = {f"{joint}.pos": float for joint in JOINTS}
        self.positions = list(positions)
        self.is_connected, self.is_calibrated, self.n_connected = False, True, 0
        self.n_reads_to_fault: int | None = None
        self.is_gone = False  # from the fault on it cannot be disconnected, either

    def connect(self, calibrate: bool = True) -> None:
        if self.n_connected:
            self.n_reads_to_fault, self.is_gone = None, False
        self.is_connected = True
        self.n_connected += 1

    def disconnect(self) -> None:
        if self.is_gone:
            raise ConnectionError("no such port")
        self.is_connected = False

    def get_action(self) -> dict[str, Any]:
        if self.n_reads_to_fault is not None:
            self.n_reads_to_fault -= 1
            if self.n_reads_to_fault <= 0:
                raise ConnectionError("no answer")
        return dict(zip(self.action_features, self.positions, strict=True))


class Person(FakeOperator):
    """Begins the phases, and marks the pick; in the trials of `fails`, from 0, that nothing will happen."""

    def __init__(self, fails: Collection[int] = ()) -> None:
        super().__init__()
        self.fails, self.trials = set(fails), list[Trial]()

    def prepare(self, trial: Trial) -> None:
        super().prepare(trial)
        mark = "done" if len(self.trials) in self.fails else "picked"
        self.trials.append(trial)
        self.waiting.clear()
        for _ in trial.stage.phases[1:]:
            self.waiting.extend([[], ["next"]])
        self.waiting.extend([*([] for _ in range(ANSWER_STEPS)), [mark]])


class Recording:
    """A session that records into a folder, and what takes part in it."""

    def __init__(
        self, out: Path, *, person: Person | None = None, leader: FakeLeader | None = None, **asked: Any
    ) -> None:
        bench = Bench(teleop={"type": "fake_leader"})
        self.arm, self.person = bench.arm, person or Person()
        self.leader = leader or FakeLeader(99.0, 99.0, 99.0)
        settings: RobotSettings = bench.settings
        assert settings.control_mode == MOTORS
        link = TeleopLink(self.leader, bench.link)
        link.connect()
        alone = Station.beside(bench.link, self.person, settings, bench.clock)
        station = dataclasses.replace(alone, operator=BesideLeader(self.person, alone, link))
        own: dict[str, Any] = {"stages": (stage_of("CubesThrownIn"),), "episodes": 1, "seed": 0}
        self.asked = Demonstrations(robot=settings, leader="fake_leader", named_out=out, **{**own, **asked})
        self.session = RecordingSession(
            asked=self.asked, station=station, leader=TeleopLeader(link), say=self.person.told.append
        )

    def run(self) -> RecordedStages:
        return self.session.run(command="")
