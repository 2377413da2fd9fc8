"""The inside of a worker process: keep an environment and a policy, run one batch at a time.

After an error it is replaced by a new process: a native library or a GPU context may be left in a state that
nothing within the process can repair.
"""

import dataclasses
import functools
import gc
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.config.environment import EnvSettings
from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    Policy,
    RememberingPolicy,
    SimEnv,
    StepObserver,
    StepResult,
)
from vla_eval.envs.factory import describe_device, make_env
from vla_eval.episode_log import check_execution
from vla_eval.errors import (
    InvalidActionError,
    RemoteConnectionError,
    RemoteReplyError,
    RemoteTimeoutError,
    SpecMismatchError,
    VlaEvalError,
)
from vla_eval.evaluation.donors import donor_memories, donor_settings
from vla_eval.evaluation.episode_jobs import EpisodeGroup, EpisodeJob
from vla_eval.evaluation.job_queue import EpisodeBatch
from vla_eval.evaluation.memory_log import FrameLog, MemoryLog, NpzLog
from vla_eval.memory_change import ChangedMemory, memory_parts
from vla_eval.models.shared.sentence_reading import ReadingPolicy, SentenceReading
from vla_eval.policies.compiled import CompiledPolicy
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.registry import make_from_adapter
from vla_eval.records import EpisodeError, EpisodeRecord, EpisodeTiming
from vla_eval.rollout import rollout
from vla_eval.seeding import seed_global_generators
from vla_eval.specs import EnvSpec, check_compatible
from vla_eval.viz.capture import EpisodeCapture
from vla_eval.viz.filming import film_again
from vla_eval.viz.tape import EpisodeTape
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import DeviceFound, Failed, Notice, describe_error, own_line

logger = logging.getLogger(__name__)

PASSING_ERRORS = (InvalidActionError, RemoteConnectionError, RemoteReplyError, RemoteTimeoutError)
"""Transient setup errors; retried: a policy server may soon be there again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """The episodes of a batch are finished; records and timings in the order of its jobs."""

    records: tuple[EpisodeRecord, ...]
    timings: tuple[EpisodeTiming, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SentenceRead(Notice):
    """A policy, by its `EpisodeGroup.part`, was asked on a task with a sentence for the first time."""

    part: str
    task: str
    reading: SentenceReading


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryFound(Notice):
    """The parts of a policy's memory that can be erased; none if it has no memory."""

    policy: str
    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkCompiled(Notice):
    """The network of a policy was compiled; the note says how far its actions differ."""

    note: str


class _StepCount(StepObserver):
    """Counts control steps for the parent, and says when a policy has inferred."""

    def __init__(self, heartbeat: Heartbeat, has_inferred: Callable[[], None]) -> None:
        self._heartbeat, self._has_inferred = heartbeat, has_inferred

    def on_inference(self, episode: EpisodeStart, step: int, chunk: ActionChunk) -> None:
        self._has_inferred()

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        self._heartbeat.count()


class EpisodeRunner:
    """Runs episodes of one group, keeping environment and policy."""

    def __init__(
        self,
        heartbeat: Heartbeat,
        tell: Callable[[Notice], None],
        capture: EpisodeCapture | None = None,
        asks_memory: bool = False,
        memories_in: Path | None = None,
        frames_in: Path | None = None,
    ) -> None:
        self._capture = capture
        self._asks_memory = asks_memory  # of the policy; False once the parent knows
        self._memories_in = memories_in  # the run folder, if what a policy remembers is kept
        self._frames_in = frames_in  # the run folder, if small frames are kept
        self._heartbeat = heartbeat
        self._tell = tell
        self._env: SimEnv | None = None
        self._filming_env: SimEnv | None = None
        self._donor_env: SimEnv | None = None
        self._policy: Policy | None = None
        self._n_told = 0  # sentences that the parent knows of

    def answer(self, job: EpisodeBatch) -> Finished | Failed:
        """Run the episodes; whatever goes wrong becomes a `Failed`."""
        self._heartbeat.begin_batch()
        refused = False
        try:
            self._heartbeat("setup")
            try:
                env, policy = self._prepare(job.jobs[0])
            except VlaEvalError as exc:
                refused = not isinstance(exc, PASSING_ERRORS)
                raise
            return self._run(env, policy, job)
        except BaseException as exc:  # also SystemExit: a policy must not end the worker unseen
            logger.exception("%s, stage %s", [one.key for one in job.jobs], self._heartbeat.stage)
            return Failed(error=self._described(exc, job), refused=refused)

    def _described(self, exc: BaseException, job: EpisodeBatch) -> EpisodeError:
        """Return what is recorded: of an exception in the user's own code also the line and the step."""
        error = describe_error(exc, self._heartbeat.stage)
        line = None if isinstance(exc, VlaEvalError) else own_line(exc)
        if line is None:
            return error
        knows_step = len(job.jobs) == 1 and error.stage in ("step", "inference")
        at = f", at control step {self._heartbeat.n_counted}" if knows_step else ""
        return dataclasses.replace(error, message=f"{error.message} ({line}{at})")

    def close(self) -> None:
        """Release the simulator."""
        for env in (self._env, self._filming_env, self._donor_env):
            if env is not None:
                env.close()
        self._env = self._filming_env = self._donor_env = self._policy = None

    def _run(self, env: SimEnv, policy: Policy, batch: EpisodeBatch) -> Finished:
        group = batch.group
        starts = [
            EpisodeStart(
                slot=job.slot,
                task=group.key.task,
                seed=job.seed,
                run=job.run,
                instruction=group.instruction,
                horizon_steps=env.spec.horizon_steps,
                row=job.row,
            )
            for job in batch.jobs
        ]
        changed = self._with_changed_memory(policy, group, starts)
        _seed_generators(starts)
        tapes = self._capture.tapes(starts, with_images=self._is_live(group)) if self._capture else None
        count = _StepCount(self._heartbeat, functools.partial(self._tell_sentences, group, policy))
        observers: list[StepObserver] = [count, *([tapes] if tapes else [])]
        logs = self._logs(policy)
        observers += [log for log, _ in logs]
        records = rollout(env, changed, starts, group.rollout, observers=observers, heartbeat=self._heartbeat)
        if self._asks_memory:
            self._asks_memory = False
            self._tell(MemoryFound(policy=group.key.policy, parts=memory_parts(policy, starts[0])))
        # The recipe's name, whatever the adapter calls itself: records are distinguished by it.
        named = tuple(dataclasses.replace(record, policy=group.key.policy) for record in records)
        for log, run in logs:
            log.write(starts, named, run)
        timings = self._heartbeat.timings([job.key for job in batch.jobs])
        if self._capture and tapes:
            self._capture.write(
                starts,
                tapes,
                named,
                env=env.spec,
                chunking=group.rollout.chunking,
                heartbeat=self._heartbeat,
                film=lambda tape: tape if self._is_live(group) else self._filmed(tape, group),
            )
        return Finished(records=named, timings=timings)

    def _logs(self, policy: Policy) -> list[tuple[NpzLog, Path]]:
        """Return what keeps arrays of these episodes, and the run folder that it writes into."""
        found: list[tuple[NpzLog, Path]] = []
        if self._memories_in is not None and isinstance(policy, RememberingPolicy) and policy.spec.has_memory:
            found.append((MemoryLog(policy), self._memories_in))
        if self._frames_in is not None:
            found.append((FrameLog(), self._frames_in))
        return found

    def _with_changed_memory(
        self, policy: Policy, group: EpisodeGroup, starts: Sequence[EpisodeStart]
    ) -> Policy:
        """Return the policy as these episodes ask it: with the memory of others put in, for example."""
        change = group.memory_change
        if change is None:
            return policy
        if not change.has_donor:
            return ChangedMemory(policy, change)
        if self._donor_env is None:
            self._heartbeat("setup")
            settings = donor_settings(self._settings_for(group, policy), change)
            self._donor_env = self._make_env(settings, group.offered)
        _seed_generators(starts)
        donors = donor_memories(
            self._donor_env, policy, starts, group.rollout, change, heartbeat=self._heartbeat
        )
        return ChangedMemory(policy, change, donors)

    def _is_live(self, group: EpisodeGroup) -> bool:
        """Whether images are captured while episodes run."""
        return self._capture is not None and not self._capture.config.films_afterwards(group.env.sim_backend)

    def _filmed(self, tape: EpisodeTape, group: EpisodeGroup) -> EpisodeTape:
        """Run an episode again, in an environment of its own that renders what is captured."""
        if self._filming_env is None:
            self._heartbeat("setup")
            self._filming_env = make_env(dataclasses.replace(self._captured(group), n_slots=1))
        return film_again(tape, self._filming_env, self._heartbeat)

    def _tell_sentences(self, group: EpisodeGroup, policy: Policy) -> None:
        """Tell the parent what the policy has read of sentences that are new."""
        known = policy.readings if isinstance(policy, ReadingPolicy) else {}
        if len(known) > self._n_told:
            for reading in list(known.values())[self._n_told :]:
                self._tell(SentenceRead(part=group.part, task=group.key.task, reading=reading))
            self._n_told = len(known)

    def _prepare(self, job: EpisodeJob) -> tuple[SimEnv, Policy]:
        group = job.group
        if self._env is None or self._policy is None:
            if self._capture is not None:
                self._capture.load()
            policy = make_policy(group)
            check_compatible(policy.spec, group.offered)
            check_execution(policy.spec, group.rollout.chunking)
            if isinstance(policy, CompiledPolicy):
                compiled = policy.warm_up(group.offered, (group.instruction,))
                if compiled is not None:
                    self._tell(NetworkCompiled(note=compiled.note(group.part)))
            self._heartbeat("setup")
            # ManiSkill collects garbage at each reset, through all that the policy's libraries imported.
            gc.freeze()
            self._env = self._make_env(self._settings_for(group, policy), group.offered)
            self._policy = policy
        return self._env, self._policy

    def _settings_for(self, group: EpisodeGroup, policy: Policy) -> EnvSettings:
        """Return what the policy needs; and what is captured, which the loop does not give to it."""
        if self._is_live(group):
            return self._captured(group)
        every = tuple(camera.name for camera in group.offered.cameras)
        cameras = policy.spec.cameras if self._frames_in is None else every
        return dataclasses.replace(group.env, cameras=cameras, privileged=policy.spec.privileged)

    def _captured(self, group: EpisodeGroup) -> EnvSettings:
        assert self._capture is not None
        return dataclasses.replace(
            group.env,
            cameras=tuple(camera.name for camera in group.offered.cameras),
            privileged=True,
            human_camera_stride=self._capture.config.frame_stride,
        )

    def _make_env(self, settings: EnvSettings, described: EnvSpec) -> SimEnv:
        env = make_env(settings)
        if env.spec != described:
            env.close()
            raise SpecMismatchError(
                f"{settings.task}: expected an environment as row and arguments describe it, {described}; "
                f"found {env.spec}. The policy was made for the first. If the task is of another package: "
                "its class must not change what `vla_eval.tasks.arguments.offered_by` reads."
            )
        if device := describe_device(env):
            self._tell(DeviceFound(device=device))
        return env


def _seed_generators(starts: Sequence[EpisodeStart]) -> None:
    """Seed them by the episode of slot 0, even if it has a result already and is not in the batch."""
    first = starts[0]
    seed_global_generators("episodes", first.task, first.run, first.seed - first.slot)


def make_policy(group: EpisodeGroup) -> Policy:
    """Make the policy of a group; errors are those of `make_from_adapter`."""
    context = PolicyContext(
        name=group.key.policy,
        env=group.offered,
        chunking=group.rollout.chunking,
        n_candidates=group.n_candidates,
        n_slots=group.env.n_slots,
    )
    return make_from_adapter(group.adapter, context, group.args)
