"""Run what has no result yet of an evaluation on an arm: one episode after another, each stored at once.

The loop is `rollout`, the environment `RobotEnv`. An episode that cannot be run to its end is an error, with
its cause, and the same command runs it again. Nothing moves before the operator has confirmed the dry run.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

from vla_eval.config.evaluation import CaptureConfig
from vla_eval.core import ObservationWindow, StepObserver, infer
from vla_eval.envs.robot.robot_env import SLOT, RobotEnv, Station
from vla_eval.episode_log import chunk_problem
from vla_eval.errors import InvalidActionError, RobotBusError
from vla_eval.policies.entries import PolicyEntry
from vla_eval.real.episodes import StageClock, about_station, ask_after_error, start_of
from vla_eval.real.evaluation import RealEvaluation
from vla_eval.real.mark_images import MarkImages
from vla_eval.real.plan import PlannedEpisode
from vla_eval.real.policies import SessionPolicies
from vla_eval.records import EpisodeRecord, EpisodeTiming
from vla_eval.rollout import rollout
from vla_eval.seeding import seed_global_generators
from vla_eval.storage.run_folder import RunFolder
from vla_eval.tasks import real_stages
from vla_eval.tasks.real_stages import COLORS, Trial
from vla_eval.viz.capture import EpisodeCapture
from vla_eval.workers.messages import describe_error


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSummary:
    """The result of one call of `Session.run`.

    Attributes:
        n_open: episodes without a result: not run, or ended in an error.
        n_errors: how many ended in an error in this call.
    """

    n_episodes: int
    n_open: int
    n_errors: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """An evaluation beside an arm that is connected."""

    evaluation: RealEvaluation
    station: Station
    say: Callable[[str], None]  # shows a line to the operator
    stops: Callable[[], bool] = lambda: False  # asked several times a second
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    policies: SessionPolicies = field(init=False)

    def __post_init__(self) -> None:
        """Load the policies: a mistake appears before anything is written."""
        policies = SessionPolicies(self.evaluation, lambda stage, entry: self._env(stage, entry).spec)
        object.__setattr__(self, "policies", policies)

    def dry_run(self) -> list[str]:
        """Read the arm, ask each policy once, command nothing; return what a person has to check.

        Raises:
            RobotError: the arm cannot be read.
            VlaEvalError: a policy does not fit.
        """
        lines = about_station(self.station)
        rows = {(one.policy, one.trial.stage.name): one for one in reversed(self.evaluation.plan)}
        for planned in rows.values():
            self._ask(planned)
        return [*lines, f"answers of policies, one per stage: {len(rows)}"]

    def run(self, *, command: str, allow_environment_change: bool = False) -> SessionSummary:
        """Run the episodes that have no result; errors as `RunFolder.open`, and those of set-up.

        Raises:
            TooManyErrorsError: so many episodes in a row ended in an error.
            RobotBusError: the arm does not come back after a fault.
            OperatorError: the operator does not want to continue.
        """
        evaluation = self.evaluation
        description = evaluation.describe(
            command=command, options={"capture": self.capture.video, "lerobot": evaluation.robot.lerobot}
        )
        groups = {evaluation.key(planned)[:3] for planned in evaluation.plan}
        n_errors = n_in_row = 0
        with RunFolder.open(
            evaluation.out, description, allow_environment_change=allow_environment_change, groups=groups
        ) as folder:
            finished = folder.finished_keys()
            waiting = [one for one in evaluation.plan if evaluation.key(one) not in finished]
            for index, planned in enumerate(waiting):
                record, timing = self._run_one(planned, folder)
                folder.append(record, timing)
                is_error = record.error is not None
                n_errors, n_in_row = n_errors + is_error, n_in_row + 1 if is_error else 0
                n_done = len(evaluation.plan) - len(waiting) + index + 1
                self.say(f"{n_done} of {len(evaluation.plan)} episodes; errors: {n_errors}")
                if is_error:
                    self._after_error(planned.trial, record, n_in_row)
            n_finished = len(folder.finished_keys())
        n_episodes = len(evaluation.plan)
        return SessionSummary(n_episodes=n_episodes, n_open=n_episodes - n_finished, n_errors=n_errors)

    def _run_one(
        self, planned: PlannedEpisode, folder: RunFolder
    ) -> tuple[EpisodeRecord, EpisodeTiming | None]:
        """Run an episode; whatever goes wrong becomes its error, and the arm is stopped."""
        evaluation, trial = self.evaluation, planned.trial
        entry = evaluation.entry(planned.policy, trial.stage)
        env, policy = self._env(trial.stage, entry, trial), self.policies.of(planned)
        start = start_of(env, trial)
        settings = evaluation.rollout(entry)
        seed_global_generators("episodes", start.task, start.run, start.seed)
        capture = EpisodeCapture(config=self.capture, folder=folder.path, seed_start=0)
        tapes = capture.tapes([start], with_images=True) if self.capture.is_on else None
        observers: list[StepObserver] = [MarkImages(folder.path, trial.number), *([tapes] if tapes else [])]
        clock = StageClock(self.stops)
        try:
            (record,) = rollout(env, policy, [start], settings, observers=observers, heartbeat=clock)
        except Exception as exc:  # of the arm, the operator, the policy: none of them is a failure
            key = evaluation.key(planned)._asdict()
            return EpisodeRecord(**key, outcome="error", error=describe_error(exc, clock.stage)), None
        finally:
            env.stop()
        record = dataclasses.replace(record, policy=planned.policy)
        timing = clock.timing(record)
        if tapes:
            capture.write(
                [start],
                tapes,
                [record],
                env=env.spec,
                chunking=settings.chunking,
                heartbeat=clock,
                film=lambda one: one,
            )
        return record, timing

    def _after_error(self, trial: Trial, record: EpisodeRecord, n_in_row: int) -> None:
        """Have the arm ready again, and ask whether to continue."""
        assert record.error is not None
        ask_after_error(self.station, trial, record.error, n_in_row, out=self.evaluation.out)
        if record.error.kind == RobotBusError.__name__:
            self.station.link.reconnect()

    def _env(self, stage: real_stages.Stage, entry: PolicyEntry, *trials: Trial) -> RobotEnv:
        station = self.station.driven(self.evaluation.settings(entry))
        return RobotEnv(station, stage, {one.seed: one for one in trials})

    def _ask(self, planned: PlannedEpisode) -> None:
        """Ask a policy for a chunk on what the arm sees now; nothing is executed."""
        policy, stage = self.policies.of(planned), planned.trial.stage
        env = self._env(stage, self.evaluation.entry(planned.policy, stage))
        start = start_of(env, planned.trial).worded({"color": COLORS[planned.trial.color]})
        policy.reset([start])
        (chunk,) = infer(
            policy, [ObservationWindow(slot=SLOT, frames=(env.look().as_declared(policy.spec),))]
        )
        problem = chunk_problem(chunk, chunk_size=policy.spec.chunk_size, dims=env.spec.action.dims)
        if problem is not None:
            raise InvalidActionError(f"policy '{policy.spec.name}', dry run of {stage.name}: {problem}")
