"""What all sessions on an arm share: how an episode begins, where it is, and what follows an error."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from vla_eval.core import EpisodeStart, Stage
from vla_eval.envs.robot.robot_env import SLOT, RobotEnv, Station
from vla_eval.errors import TooManyErrorsError
from vla_eval.records import EpisodeError, EpisodeRecord, EpisodeTiming
from vla_eval.tasks.real_stages import Trial

RUN = 0
MAX_CONSECUTIVE_ERRORS = 5
TIMED: tuple[Stage, ...] = ("reset", "step", "inference")
LIMITS = ("control_hz", "max_step", "response_seconds", "stale_frames", "max_gap_seconds")
"""Settings that the dry run shows."""


@dataclass(slots=True)
class StageClock:
    """Seconds of an episode, by what was being done; asks before each whether the session has to stop."""

    stops: Callable[[], bool]
    stage: Stage = "setup"
    began: float = field(default_factory=time.monotonic)
    seconds: dict[Stage, float] = field(default_factory=lambda: dict.fromkeys(TIMED, 0.0))

    def __call__(self, stage: Stage) -> None:
        """Note what is about to be done."""
        if self.stops():
            raise KeyboardInterrupt
        self._add_up()
        self.stage = stage

    def timing(self, record: EpisodeRecord) -> EpisodeTiming:
        """Return the times of the episode that has just ended."""
        self._add_up()
        return EpisodeTiming(
            key=record.key,
            total_seconds=sum(self.seconds.values()),
            reset_seconds=self.seconds["reset"],
            step_seconds=self.seconds["step"],
            inference_seconds=self.seconds["inference"],
        )

    def _add_up(self) -> None:
        now = time.monotonic()
        if self.stage in self.seconds:
            self.seconds[self.stage] += now - self.began
        self.began = now


def start_of(env: RobotEnv, trial: Trial) -> EpisodeStart:
    """Return the episode of a trial."""
    return EpisodeStart(
        slot=SLOT,
        task=env.spec.task,
        seed=trial.seed,
        run=RUN,
        instruction=trial.stage.instruction,
        horizon_steps=env.spec.horizon_steps,
    )


def about_station(station: Station) -> list[str]:
    """Read the arm, and return what a person has to check before it moves; errors as `RobotLink.read`."""
    lines = []
    for name, position in zip(station.link.motors, station.link.read().motors.tolist(), strict=True):
        limits = station.settings.limits.get(name)
        within = "no limits" if limits is None else f"within {limits[0]:g} to {limits[1]:g}"
        home = station.settings.home.get(name)
        at_home = "home is here" if home is None else f"home {home:g}"
        lines.append(f"motor {name}: {position:.1f}, {within}, {at_home}")
    for camera in station.link.cameras:
        lines.append(f"camera {camera.name}: {camera.width_px} x {camera.height_px}")
    return [*lines, *(f"{name}: {getattr(station.settings, name):g}" for name in LIMITS)]


def ask_after_error(station: Station, trial: Trial, error: EpisodeError, n_in_row: int, *, out: Path) -> None:
    """Say what has gone wrong, and ask whether to continue.

    Raises:
        TooManyErrorsError: it is the last of too many in a row.
        OperatorError: the operator does not want to continue.
    """
    cause = f"{error.kind} during {error.stage}: {error.message}"
    if n_in_row >= MAX_CONSECUTIVE_ERRORS:
        raise TooManyErrorsError(
            f"{n_in_row} episodes in a row ended in an error. The last: episode {trial.number}: "
            f"{cause} All results are kept in {out}; the same command runs the others."
        )
    station.operator.ask(f"{cause}\nThe episode is run again by the same command. Continue with the next?")
