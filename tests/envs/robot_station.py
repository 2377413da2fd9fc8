"""An arm and a person of a few lines each: arrays and lists, no device, no simulator and no waiting."""

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from vla_eval.config.real_robot import RobotSettings
from vla_eval.envs.robot.link import RobotLink
from vla_eval.envs.robot.robot_env import RobotEnv, Station
from vla_eval.envs.robot.watch import StepClock
from vla_eval.tasks.real_stages import Trial, stage_of

JOINTS = ("pan", "lift", "gripper")


class FakeArm:
    """Goes where it is sent, at once; `fails`: what raises when it is called."""

    name = "fake_arm"

    def __init__(self) -> None:
        self.action_features: dict[str, Any] = {f"{joint}.pos": float for joint in JOINTS}
        self.observation_features = {**self.action_features, "front": (4, 6, 3)}
        self.motors = [10.0, -20.0, 50.0]
        self.sent: list[list[float]] = []
        self.changes: dict[str, Any] = {}  # what an observation holds in place of what it should
        self.fails: set[str] = set()
        self.is_frozen, self.is_connected, self.is_calibrated = False, False, True
        self._n_images = 0

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True
        self.fails.clear()

    def disconnect(self) -> None:
        self.is_connected = False

    def get_observation(self) -> dict[str, Any]:
        self._refuse("reading")
        self._n_images += not self.is_frozen
        image = np.full((4, 6, 3), self._n_images % 256, dtype=np.uint8)
        return {**dict(zip(self.action_features, self.motors, strict=True)), "front": image, **self.changes}

    def send_action(self, action: dict[str, float]) -> None:
        self._refuse("commanding")
        self.motors = list(action.values())
        self.sent.append(self.motors)

    def _refuse(self, doing: str) -> None:
        if doing in self.fails:
            raise ConnectionError("no answer")


class FakeOperator:
    """Presses what a test puts into `waiting`, one list per control step."""

    def __init__(self) -> None:
        self.waiting: deque[list[str]] = deque()
        self.is_held = True
        self.told: list[str] = []

    def prepare(self, trial: Trial) -> None:
        self.told.append(trial.words(trial.stage.phases[0]))

    def ask(self, words: str) -> None:
        self.told.append(words)

    tell = ask

    def pressed(self) -> Sequence[str]:
        return self.waiting.popleft() if self.waiting else []

    def until_held(self) -> None:
        self.is_held = True

    def lets_move(self) -> bool:
        return self.is_held


class Bench:
    """A station, and an environment of one stage on it."""

    def __init__(self, stage: str = "CubesShuffled", **settings: Any) -> None:
        own = {"control_hz": 10.0, "max_step": 5.0, "response_seconds": 3.0, "operator_seconds": 2.0}
        self.settings = RobotSettings(lerobot={"type": "fake_arm"}, **{**own, **settings})
        self.arm, self.operator, self.clock = FakeArm(), FakeOperator(), StepClock()
        self.link = RobotLink(self.arm)
        self.link.connect()
        self.station = Station.beside(self.link, self.operator, self.settings, self.clock)
        self.trial = Trial(number=1, seed=7, stage=stage_of(stage), color=2, places=(2, 0, 1))
        self.env = RobotEnv(self.station, self.trial.stage, {7: self.trial})

    def reset(self) -> Any:
        return self.env.reset({0: 7}, render=True)[0]

    def step(self, *keys: str, action: Sequence[float] = (99.0, 99.0, 99.0)) -> Any:
        self.operator.waiting.append(list(keys))
        return self.env.step({0: np.array(action, dtype=np.float32)}, render=frozenset({0}))[0]

    def answer(self) -> Any:
        """Begin the last phase."""
        result = self.reset()
        for _ in self.trial.stage.phases[1:]:
            result = self.step("next")
        return result
