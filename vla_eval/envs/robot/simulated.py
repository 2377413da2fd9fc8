"""`simulated_so100`: LeRobot's `Robot` over the simulated twin of the stages, and faults to rehearse.

It has the interface of LeRobot's SO followers: positions of motors in degrees, the gripper 0 to 100, cameras
by name. What a person does beside a real arm is `place`.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any  # lerobot is untyped

import numpy as np
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot

from vla_eval.config.environment import EnvSettings
from vla_eval.config.real_robot import SIMULATED_TYPE
from vla_eval.control_modes import JOINT_POS, POSITION
from vla_eval.core import ImageArray, SimEnv, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.envs.robot.units import GRIPPER_OPEN
from vla_eval.errors import SimulationError
from vla_eval.features import IMAGE_SHAPE
from vla_eval.robots.find import ROBOT
from vla_eval.robots.rows import SO100
from vla_eval.seeding import Stream, generator
from vla_eval.task_state import PrivilegedState, TaskStatus
from vla_eval.tasks.interface import CAMERA_NAMES
from vla_eval.tasks.real_stages import STAGES, Trial
from vla_eval.tasks.real_twin import drawn

FAULT_STEP = 3  # control steps into the episode
SEEDS_PER_TRIAL = 1000  # of which 1 in 18 has colour and places of the trial


@RobotConfig.register_subclass(SIMULATED_TYPE)
@dataclass(kw_only=True)
class SimulatedSO100Config(RobotConfig):  # type: ignore[misc]  # lerobot is untyped
    """LeRobot's configuration of the simulated arm."""

    views: list[str] = field(default_factory=lambda: list(CAMERA_NAMES))  # its cameras
    noise_levels: int = 1  # each number of an image is off by up to so much, as that of a camera is


class SimulatedSO100(Robot):  # type: ignore[misc]  # lerobot is untyped
    """The simulated arm; see the module docstring."""

    config_class = SimulatedSO100Config
    name = SIMULATED_TYPE

    def __init__(self, config: SimulatedSO100Config) -> None:
        """Make no simulator yet."""
        super().__init__(config)
        self.config = config
        self.faults: dict[int, str] = {}  # number of an episode -> what goes wrong in it, once (`FAULTS`)
        self.sent: list[dict[str, float]] = []  # commands of the present episode
        self._envs: dict[str, SimEnv] = {}
        self._env: SimEnv | None = None
        self._result: StepResult | None = None
        self._seed = 0
        self._frozen: dict[str, ImageArray] = {}
        self._fault: str | None = None  # of the present episode
        self._is_connected = False

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Motors and cameras, as LeRobot's SO followers have them."""
        return {**self.action_features, **dict.fromkeys(self.config.views, IMAGE_SHAPE)}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Positions of the motors."""
        return {f"{joint}{POSITION}": float for joint in SO100.joints}

    @property
    def is_connected(self) -> bool:
        """Whether it is."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """Always: its degrees are the angles of its model."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Connect; the arm is at rest then."""
        self._is_connected, self._fault = True, None
        if self._result is None:
            self.place(Trial(number=0, seed=0, stage=STAGES[0], color=0, places=tuple(range(3))))

    def calibrate(self) -> None:
        """Nothing is to be done."""

    def configure(self) -> None:
        """Nothing is to be done."""

    def disconnect(self) -> None:
        """Disconnect; the simulators stay, and the arm is put to rest."""
        self._is_connected, self._result = False, None

    def close(self) -> None:
        """Release the simulators."""
        for env in self._envs.values():
            env.close()
        self._envs, self._env = {}, None

    def place(self, trial: Trial) -> None:
        """Set the table for a trial, as a person does: of the episodes of its own, the first that fits."""
        stage = trial.stage.twin_id
        if stage not in self._envs:
            kwargs = {ROBOT: SO100.name}
            cameras = tuple(self.config.views)
            self._envs[stage] = make_env(
                EnvSettings(task=stage, kwargs=kwargs, cameras=cameras, privileged=True)
            )
        self._env = self._envs[stage]
        first, wanted = trial.seed * SEEDS_PER_TRIAL, (trial.color, trial.places)
        seed = next(seed for seed in range(first, first + SEEDS_PER_TRIAL) if drawn(seed) == wanted)
        self._seed, self._frozen, self.sent = seed, {}, []
        self._result = self._env.reset({0: seed}, render=bool(self.config.views))[0]
        found = self._result.status
        if (found.target, found.candidate_places) != wanted:
            raise SimulationError(
                f"{stage}, seed {seed}: expected {wanted}, found {found}. Please report it."
            )
        self._fault = self.faults.pop(trial.number, None) if self._is_connected else None

    @property
    def status(self) -> TaskStatus:
        """What the simulator says of the episode: for the scripted operator."""
        return self._last.status

    @property
    def n_steps(self) -> int:
        """Control steps since the table was set."""
        return self._last.observation.step

    def true_state(self) -> PrivilegedState:
        """Return the true state, for scripted policies."""
        state = self._last.observation.privileged
        assert isinstance(state, PrivilegedState)  # the environment is made with it
        return state

    def has_fault(self, *kinds: str) -> bool:
        """Whether one of these faults is there now."""
        return self._fault in kinds and self.n_steps >= FAULT_STEP

    def end_fault(self, *kinds: str) -> None:
        """End one of these faults, if it is there."""
        if self._fault in kinds:
            self._fault = None

    def get_observation(self) -> dict[str, Any]:
        """Return positions and images."""
        self._refuse()
        qpos, jaw = self._last.observation.state["qpos"].astype(np.float64), SO100.gripper
        share = (qpos[-1] - jaw.closed) / (jaw.opened - jaw.closed)
        motors = [*np.degrees(qpos[:-1]).tolist(), float(share) * GRIPPER_OPEN]
        return {**dict(zip(self.action_features, motors, strict=True)), **self._images()}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Drive the motors for a control step."""
        self._refuse()
        assert self._env is not None
        self.sent.append(dict(action))
        motors = [action[name] for name in self.action_features]
        numbers = [*np.radians(motors[:-1]), motors[-1] / GRIPPER_OPEN * 2 - 1]
        low, high = SO100.actions[JOINT_POS].low, SO100.actions[JOINT_POS].high
        command = np.clip(np.array(numbers, dtype=np.float32), low, high).astype(np.float32)
        slots = frozenset({0}) if self.config.views else frozenset[int]()
        self._result = self._env.step({0: command}, render=slots)[0]
        return action

    @property
    def _last(self) -> StepResult:
        assert self._result is not None  # since `connect`
        return self._result

    def _images(self) -> dict[str, ImageArray]:
        if self._frozen and self.has_fault("camera"):
            return dict(self._frozen)
        levels, draws = self.config.noise_levels, generator(self._seed, Stream.NOISE, self.n_steps)
        self._frozen = {
            name: np.clip(
                image + draws.integers(-levels, levels, image.shape, dtype=np.int16, endpoint=True), 0, 255
            ).astype(np.uint8)
            for name, image in self._last.observation.images.items()
        }
        return dict(self._frozen)

    def _refuse(self) -> None:
        if self.has_fault("power"):
            self._is_connected = False
        if not self._is_connected or self.has_fault("cable"):
            raise ConnectionError("there is no answer from the bus.")
