"""`SimEnv` on a robot arm: one stage, one slot, an operator in place of the simulator's rules.

Knows LeRobot's robot by `RobotLink` alone. The arm is held still in all phases but the last, whatever the
policy says; an error stops it, and nothing moves before the next reset.
"""

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

import numpy as np

from vla_eval.config.real_robot import RobotSettings
from vla_eval.core import FloatArray, Observation, StepResult
from vla_eval.envs.robot.link import Motors, Reading, RobotLink
from vla_eval.envs.robot.operators import ABORT, DONE, NEXT, PICKED, Operator
from vla_eval.envs.robot.units import Units
from vla_eval.envs.robot.watch import CameraWatch, Clock, Pace
from vla_eval.errors import OperatorError, RobotBusError, RobotError
from vla_eval.specs import EnvSpec
from vla_eval.task_state import PrivilegedState, TaskStatus
from vla_eval.tasks.real_stages import CHANCE, COLORS, Stage, StagePhase, Trial

HOME_TOLERANCE = 5.0  # LeRobot's numbers: so near to it, the arm is at home
STALL_SECONDS = 1.0  # without coming nearer, on the way home: something holds the arm
SLOT = 0

logger = logging.getLogger(__name__)


@runtime_checkable
class KnowsTruth(Protocol):
    """A robot that is simulated, and can tell the true state of its world."""

    def true_state(self) -> PrivilegedState:
        """Return it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Station:
    """What all stages of a session share: an arm, a person, and how it is driven."""

    link: RobotLink
    operator: Operator
    settings: RobotSettings
    clock: Clock
    units: Units
    home: Motors  # where the arm is when an episode begins

    @classmethod
    def beside(cls, link: RobotLink, operator: Operator, settings: RobotSettings, clock: Clock) -> Self:
        """Return the station of an arm that is connected."""
        units, here = Units.of(settings, link.motors), link.read().motors
        pairs = zip(link.motors, here.tolist(), strict=True)
        home = np.array([settings.home.get(name, position) for name, position in pairs])
        return cls(link=link, operator=operator, settings=settings, clock=clock, units=units, home=home)

    def driven(self, settings: RobotSettings) -> Self:
        """Return the same arm, driven in another way, such as another control mode."""
        return dataclasses.replace(self, settings=settings, units=Units.of(settings, self.link.motors))


@dataclass(slots=True, kw_only=True)
class _Running:
    """The episode under way."""

    trial: Trial
    reading: Reading
    before: Motors  # the motors one control step earlier
    held: Motors  # where the arm is held
    phase: int = 0  # index in the stage
    phase_step: int = 0  # control step at which it began
    n_steps: int = 0
    n_response_steps: int = 0
    n_limited_steps: int = 0
    touched: tuple[int, ...] = ()
    is_picked: bool = False
    is_over: bool = False


class RobotEnv:
    """One stage on a robot arm; see the module docstring."""

    def __init__(self, station: Station, stage: Stage, trials: Mapping[int, Trial]) -> None:
        """Drive nothing yet; `trials`: those that it can be reset to, by their seeds."""
        self._station, self._stage, self._trials = station, stage, trials
        settings = station.settings
        self._response_steps = round(settings.response_seconds * settings.control_hz)
        self._operator_steps = round(settings.operator_seconds * settings.control_hz)
        self._pace = Pace(
            station.clock, control_hz=settings.control_hz, max_gap_seconds=settings.max_gap_seconds
        )
        self._now: _Running | None = None
        self.spec = EnvSpec(
            task=stage.twin_id if settings.is_simulated else stage.real_id,
            cameras=station.link.cameras,
            states=station.units.states,
            action=station.units.action,
            horizon_steps=self._operator_steps * (len(stage.phases) - 1) + self._response_steps,
            control_hz=settings.control_hz,
            robot=None if station.units.arm is None else station.units.arm.name,
        )

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Bring the arm home, then have the table set for a trial; see `SimEnv.reset`."""
        trial = self._trials[seeds[SLOT]]
        self._now = None
        self._watch = CameraWatch(stale_frames=self._station.settings.stale_frames)
        self._pace.begin()
        self._go_home()
        self._station.operator.prepare(trial)
        try:
            reading = self._station.link.read()
            self._now = _Running(trial=trial, reading=reading, before=reading.motors, held=reading.motors)
            self._announce()
            self._now.reading = self._station.link.read()  # the operator may have taken his time
        except BaseException:
            self.stop()
            raise
        return {SLOT: self._result(wording={"color": COLORS[trial.color]})}

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Command the arm for one control step, and read it at its end; see `SimEnv.step`."""
        now = self._running()
        try:
            executed = self._drive(now, actions[SLOT])
            now.before, now.reading = now.reading.motors, self._station.link.read()
            self._watch.check(now.reading.images)
        except BaseException:  # Ctrl-C, too
            self.stop()
            raise
        now.n_steps += 1
        now.is_over |= now.n_response_steps >= self._response_steps
        if now.is_over and now.n_limited_steps:
            step = self._station.settings.max_step
            logger.warning(
                "%d of %d steps asked for more than max_step=%g from where a motor was, and were limited",
                *(now.n_limited_steps, now.n_steps, step),
            )
        return {SLOT: self._result(executed)}

    def look(self) -> Observation:
        """Return what can be observed now, outside of an episode; nothing is commanded."""
        reading = self._station.link.read()
        return self._observation(reading, reading.motors, step=0)

    def hold_action(self, slot: int) -> FloatArray:
        """Return the action that leaves the arm as it is; see `SimEnv.hold_action`."""
        return self._station.units.action_of(self._running().reading.motors)

    def stop(self) -> None:
        """Hold the arm where it was last seen, and command nothing more."""
        now, self._now = self._now, None
        if now is None:
            return
        try:
            self._station.link.send(now.reading.motors)
        except RobotBusError as exc:  # the first error says more
            logger.warning("the command to hold still failed, too: %s", exc)

    def close(self) -> None:
        """Leave the arm where it is: the session disconnects it."""
        self._now = None

    def _running(self) -> _Running:
        if self._now is None:
            raise RobotError(
                f"{self.spec.task}: the arm has been stopped; it moves again in the next episode."
            )
        return self._now

    def _drive(self, now: _Running, action: FloatArray) -> FloatArray:
        """Take the operator's keys, command the arm, wait; return the action as it was carried out."""
        station = self._station
        self._take_keys(now)
        goal = now.held
        if not self._moves(now):
            self._pace.begin()  # a gap between two commands to stay harms nobody
        else:
            if not station.operator.lets_move():
                raise OperatorError(
                    f"the dead man's key was let go at control step {now.n_steps}: the arm holds still, "
                    "and the episode is run again."
                )
            goal = self._limited(now, station.units.goal(action))
            now.n_response_steps += 1
            now.held = now.reading.motors
        self._pace.check()
        station.link.send(goal)
        self._pace.wait()
        return station.units.action_of(goal)

    def _limited(self, now: _Running, goal: Motors) -> Motors:
        """Return a goal not further from where the motors are than a control step allows."""
        step, here = self._station.settings.max_step, now.reading.motors
        limited = np.clip(goal, here - step, here + step)
        now.n_limited_steps += bool((limited != goal).any())
        return limited

    def _take_keys(self, now: _Running) -> None:
        for key in self._station.operator.pressed():
            if key == ABORT:
                raise OperatorError(f"the operator stopped the episode at control step {now.n_steps}.")
            if key == NEXT and now.phase < len(self._stage.phases) - 1:
                now.phase, now.phase_step = now.phase + 1, now.n_steps
                self._announce()
            elif self._answers(now):
                self._mark(now, key)
        if not self._answers(now) and now.n_steps - now.phase_step >= self._operator_steps:
            raise OperatorError(
                f"no answer for {self._station.settings.operator_seconds:g} s (operator_seconds) to: "
                f"{now.trial.words(self._stage.phases[now.phase + 1])}"
            )

    def _moves(self, now: _Running) -> bool:
        """Whether the arm may move: from the first observation on that was made in the last phase."""
        is_new = now.phase > 0 and now.n_steps == now.phase_step
        return self._answers(now) and not is_new and not now.is_over

    def _answers(self, now: _Running) -> bool:
        """Whether it is the last phase."""
        return now.phase == len(self._stage.phases) - 1

    def _mark(self, now: _Running, key: str) -> None:
        target = now.trial.color
        if key in COLORS or key == PICKED:
            touched = target if key == PICKED else COLORS.index(key)
            now.touched += () if touched in now.touched else (touched,)
            now.is_picked |= key == PICKED
        now.is_over |= key == DONE

    def _announce(self) -> None:
        """Say what comes next; before the arm moves, wait for the dead man's key."""
        now = self._running()
        later: tuple[StagePhase, ...] = self._stage.phases[now.phase + 1 :]
        if later:
            self._station.operator.tell(f"{now.trial.words(later[0])} Then Enter.")
            return
        self._station.operator.until_held()
        self._pace.begin()

    def _go_home(self) -> None:
        """Bring the arm to where an episode begins, a control step's way at a time."""
        station = self._station
        step, here = station.settings.max_step, station.link.read().motors
        least, n_stalled = np.inf, 0
        if np.abs(station.home - here).max() > HOME_TOLERANCE:
            station.operator.until_held()
        while np.abs(station.home - here).max() > HOME_TOLERANCE:
            off = float(np.abs(station.home - here).sum())
            least, n_stalled = min(least, off), 0 if off < least else n_stalled + 1
            if n_stalled > STALL_SECONDS * station.settings.control_hz:
                left = np.round(station.home - here, 1).tolist()
                raise RobotBusError(
                    f"the arm did not come home: {dict(zip(station.link.motors, left, strict=True))} are "
                    "left. Free it, and check its torque."
                )
            if not station.operator.lets_move():
                raise OperatorError("the dead man's key was let go while the arm moved home.")
            station.link.send(np.clip(station.home, here - step, here + step))
            self._pace.check()
            self._pace.wait()
            here = station.link.read().motors

    def _result(
        self, executed: FloatArray | None = None, wording: Mapping[str, str] | None = None
    ) -> StepResult:
        now = self._running()
        observation = self._observation(now.reading, now.before, step=now.n_steps)
        return StepResult(
            observation=observation,
            status=self._status(now),
            executed_action=executed,
            wording=wording or {},
        )

    def _observation(self, reading: Reading, before: Motors, *, step: int) -> Observation:
        station, robot = self._station, self._station.link.device
        hz = station.settings.control_hz
        return Observation(
            step=step,
            images=reading.images,
            state=station.units.state(reading.motors, before, control_hz=hz),
            privileged=robot.true_state() if isinstance(robot, KnowsTruth) else None,
        )

    def _status(self, now: _Running) -> TaskStatus:
        target = now.trial.color
        return TaskStatus(
            phase=self._stage.phases[now.phase].phase,
            success=now.is_picked,
            is_over=now.is_over,
            n_candidates=len(COLORS),
            n_wrong_choices=sum(one != target for one in now.touched),
            right_first_choices=(target,),
            chance_success=CHANCE,
            candidate_places=now.trial.places,
            right_candidates=(target,),
            touched_candidates=now.touched,
        )
