"""Record demonstrations of the stages on an arm: one LeRobotDataset per stage.

The loop is `rollout`, the environment `RobotEnv`, the policy a `Leader`. An episode that is kept is stored at
once; one without success is discarded, and another trial of its stage and colour takes its place; one that
ended in an error is recorded again.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from vla_eval import __version__
from vla_eval.core import EpisodeStart, FloatArray, Policy, StepObserver, StepResult
from vla_eval.data.facts import ArmFacts
from vla_eval.data.manifest import ArmEpisode, DiscardedTrial
from vla_eval.data.recording.arm import StageRecording
from vla_eval.data.recording.demonstrations import phase_steps
from vla_eval.data.recording.folder import RecordingFolder
from vla_eval.data.recording.shard_writer import ShardWriter
from vla_eval.envs.robot.robot_env import RobotEnv, Station
from vla_eval.errors import RecordingError, RobotBusError
from vla_eval.features import arm_features, arm_frame
from vla_eval.real.demonstrations import Demonstrations
from vla_eval.real.episodes import StageClock, about_station, ask_after_error, start_of
from vla_eval.real.leaders import ONE_BY_ONE, Leader
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.seeding import seed_global_generators
from vla_eval.specs import check_compatible
from vla_eval.storage.provenance import collect_environment
from vla_eval.task_state import Phase
from vla_eval.tasks.real_stages import COLORS, Stage, Trial
from vla_eval.workers.messages import describe_error

MAX_DISCARDED_IN_ROW = 10
SETTINGS = RolloutSettings(chunking=ONE_BY_ONE, stop_at_success=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedStages:
    """The result of one call of `RecordingSession.run`: the datasets by their folders, and what happened."""

    datasets: dict[Path, ArmFacts]
    n_errors: int


class _Frames(StepObserver):
    """Encodes the frames of an episode while it runs: each once it is known whether it is the last one."""

    def __init__(self, writer: ShardWriter) -> None:
        self._writer = writer
        self._waiting: tuple[StepResult, StepResult] | None = None
        self.phases: list[Phase | None] = []
        self.instruction = ""

    def wants_images(self, step: int) -> bool:
        return True

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        self.instruction, self.last = episode.instruction, result
        self.phases.append(result.status.phase)

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        self._write(is_last=False)
        self._waiting, self.last = (self.last, result), result
        self.phases.append(result.status.phase)

    @property
    def n_steps(self) -> int:
        """Control steps executed."""
        return len(self.phases) - 1

    def finish(self) -> None:
        """Encode the last frame."""
        self._write(is_last=True)

    def _write(self, *, is_last: bool) -> None:
        if self._waiting is None:
            return
        before, after = self._waiting
        assert after.executed_action is not None  # of an arm
        frame = arm_frame(
            before.observation,
            action=after.executed_action,
            is_success=after.status.success,
            is_last=is_last,
        )
        self._writer.add_frame(frame, self.instruction)


@dataclass(frozen=True, kw_only=True)
class RecordingSession:
    """A recording beside an arm, and what leads it, that are connected."""

    asked: Demonstrations
    station: Station
    leader: Leader
    say: Callable[[str], None]  # shows a line to the operator
    stops: Callable[[], bool] = lambda: False  # asked several times a second

    def dry_run(self) -> list[str]:
        """Read arm and leader, command nothing; return what a person has to check; errors as theirs."""
        for stage in self.asked.stages:
            check_compatible(self._policy(stage).spec, self._env(stage, {}).spec)
        return [*about_station(self.station), *self.leader.about()]

    def run(self, *, command: str, allow_environment_change: bool = False) -> RecordedStages:
        """Record what is missing, then make the datasets; errors as `RecordingFolder.open`, and these.

        Raises:
            TooManyErrorsError: so many episodes in a row ended in an error.
            RecordingError: so many in a row were without success, or a dataset has another number of them.
            RobotBusError: the arm does not come back after a fault.
            OperatorError: the operator does not want to continue.
        """
        asked = self.asked
        description = asked.describe(command=command)
        with RecordingFolder.open(
            asked.out, description, allow_environment_change=allow_environment_change
        ) as folder:
            stages = {stage.name: StageRecording(folder, asked.task(stage)) for stage in asked.stages}
            open_ones = {name: one for name, one in stages.items() if not one.is_finished}
            n_errors = self._record_missing(open_ones)
            self._join(open_ones)
            datasets = {one.path: one.facts() for one in stages.values()}
        for path, facts in datasets.items():
            self._check_number(path, facts)
        return RecordedStages(datasets=datasets, n_errors=n_errors)

    def _record_missing(self, stages: Mapping[str, StageRecording]) -> int:
        """Record episodes until all are there; return how many ended in an error."""
        n_errors = n_in_row = n_discarded_in_row = 0
        total = self.asked.episodes * len(COLORS) * len(stages)
        while True:
            used, trial = self._chosen(stages)
            if trial is None:
                return n_errors
            self.say(f"{len(used)} of {total} demonstrations")
            found = self._record_one(trial, stages[trial.stage.name])
            if isinstance(found, EpisodeError):
                n_errors, n_in_row = n_errors + 1, n_in_row + 1
                ask_after_error(self.station, trial, found, n_in_row, out=self.asked.out)
                if found.kind == RobotBusError.__name__:
                    self.station.link.reconnect()
                    self.leader.reconnect()
                continue
            n_in_row, n_discarded_in_row = 0, 0 if found else n_discarded_in_row + 1
            if n_discarded_in_row >= MAX_DISCARDED_IN_ROW:
                raise RecordingError(
                    f"{n_discarded_in_row} episodes in a row were discarded: in none of them was the right "
                    "cube marked as picked. Check leader, arm and marks; the same command continues."
                )

    def _chosen(self, stages: Mapping[str, StageRecording]) -> tuple[list[Trial], Trial | None]:
        kept = {name: set(one.shards) for name, one in stages.items()}
        return self.asked.chosen(kept, {number for one in stages.values() for number in one.discarded})

    def _record_one(self, trial: Trial, store: StageRecording) -> bool | EpisodeError:
        """Record the episode of a trial; return whether it is kept, or its error. The arm is stopped then."""
        env = self._env(trial.stage, {trial.seed: trial})
        policy, start = self._policy(trial.stage), start_of(env, trial)
        seed_global_generators("demonstrations", start.task, start.run, start.seed)
        clock = StageClock(self.stops)
        with store.writer(
            trial.number, arm_features(env.spec), env=env.spec, robot=self.asked.robot.type
        ) as writer:
            frames = _Frames(writer)
            try:
                (record,) = rollout(env, policy, [start], SETTINGS, observers=[frames], heartbeat=clock)
            except Exception as exc:  # of the arm, the leader, the operator
                writer.discard()
                return describe_error(exc, clock.stage)
            finally:
                env.stop()
            is_kept = bool(record.success_once) or self.asked.keep == "all"
            if is_kept:
                frames.finish()
                writer.save(_episode(trial, record, frames))
            else:
                writer.discard()
        if is_kept:
            store.add(trial.number)
        else:
            store.discard(DiscardedTrial(number=trial.number, n_steps=frames.n_steps))
            self.say(
                f"Discarded: the right cube was not marked as picked. Another {COLORS[trial.color]} episode "
                f"of {trial.stage.name} takes its place ({len(store.discarded)} discarded so far)."
            )
        return is_kept

    def _join(self, stages: Mapping[str, StageRecording]) -> None:
        """Make the datasets that are not there yet."""
        used, _ = self._chosen(stages)
        asked = self.asked
        for name, store in stages.items():
            self.say(f"{store.path}: putting the episodes together")
            facts = ArmFacts(
                complete=True,
                task=store.task,
                robot=asked.robot.type,
                settings=asked.robot.content,
                leader=asked.leader,
                teleop=asked.robot.teleop_content,
                n_frames=0,
                n_discarded=0,
                episodes=(),
                environment=collect_environment(),
                files={},
                vla_eval_version=__version__,
            )
            store.join([trial.number for trial in used if trial.stage.name == name], facts)

    def _check_number(self, path: Path, facts: ArmFacts) -> None:
        expected, found = self.asked.episodes * len(COLORS), len(facts.episodes)
        if found != expected:
            raise RecordingError(
                f"{path}: expected {expected} episodes, found a finished dataset of {found}. Record the "
                "others into another --out, with another --plan-seed; `mikasa-vla dataset mix` puts both "
                "together."
            )

    def _policy(self, stage: Stage) -> Policy:
        return self.leader.policy(self.station, stage)

    def _env(self, stage: Stage, trials: Mapping[int, Trial]) -> RobotEnv:
        return RobotEnv(self.station, stage, trials)


def _episode(trial: Trial, record: EpisodeRecord, frames: _Frames) -> ArmEpisode:
    steps = phase_steps(frames.phases)
    return ArmEpisode(
        number=trial.number,
        seed=trial.seed,
        instruction=frames.instruction,
        color=COLORS[trial.color],
        places=trial.places,
        cue_steps=steps.cue,
        delay_steps=steps.delay,
        n_steps=frames.n_steps,
        success_step=record.success_step,
        touched=tuple(COLORS[index] for index in frames.last.status.touched_candidates or ()),
    )
