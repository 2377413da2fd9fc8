"""Demonstrations of a training that imitates: the scripted expert acts in the training's environments."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple  # Any: arrays of any dtype

import numpy as np
from numpy.typing import NDArray

from vla_eval.agents.job import AgentJob
from vla_eval.base_tasks.named import DISCRETE
from vla_eval.config.agents import TRAINING_SEEDS
from vla_eval.config.prompts import instruction_for
from vla_eval.core import EpisodeStart, FloatArray, Policy, SimEnv, StepObserver, StepResult
from vla_eval.data.recording.demonstrations import ONE_BY_ONE, EpisodeLog, NoisyEnv
from vla_eval.errors import TrainingError
from vla_eval.policies.agents.imitator import as_inputs
from vla_eval.policies.agents.observing import Reader
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.registry import make_from_adapter
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.seeding import Stream, generator
from vla_eval.tasks.catalog import task_spec

EXPERT = "oracle"
DEMONSTRATION, ORDER, EXCHANGE = 0, 1, 2
"""What is drawn for an imitation, apart from all that belongs to a checkpoint."""
ENOUGH_TRIES = 4  # so many times the demonstrations asked for; an expert that needs more is none


class Demonstration(NamedTuple):
    """One episode of the expert."""

    inputs: FloatArray  # (T, inputs) what an agent would have been given
    actions: FloatArray  # (T, A) what the expert asked for, in the agent's action space
    meant: NDArray[np.int64]  # (T,) the candidate in view that it touched next; -1: none


@dataclass(slots=True)
class _Logs(StepObserver):
    """What happened in each slot."""

    of_slot: dict[int, EpisodeLog] = field(default_factory=dict)

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Begin the log of an episode."""
        self.of_slot[episode.slot] = EpisodeLog(results=[result])

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Keep action and result."""
        self.of_slot[episode.slot].on_step(episode, action, result)


@dataclass(frozen=True, slots=True, kw_only=True)
class Expert:
    """The expert of a task, and where it acts."""

    env: SimEnv
    policy: Policy
    reader: Reader
    n_slots: int
    run_seed: int
    is_base: bool
    instruction: str

    @classmethod
    def of(cls, job: AgentJob, env: SimEnv) -> "Expert":
        """Make the expert of a training.

        Raises:
            SpecMismatchError: the task has none.
        """
        task = task_spec(job.task)
        context = PolicyContext(
            name=EXPERT,
            env=env.spec,
            chunking=ONE_BY_ONE,
            n_candidates=task.n_candidates(job.settings.kwargs),
            n_slots=job.settings.n_slots,
        )
        return cls(
            env=env,
            policy=make_from_adapter(EXPERT, context, {}),
            reader=job.reader,
            n_slots=job.settings.n_slots,
            run_seed=job.run_seed,
            is_base=task.is_base,
            instruction="" if task.is_base else instruction_for(task),
        )

    def demonstrations(self, n: int, *, noise: float) -> Iterator[list[Demonstration]]:
        """Act until there are `n`, and yield them as they come.

        A robot's end at their first success, and those without one are left out; others are kept as they are.

        Args:
            n: how many.
            noise: standard deviation of what an arm is pushed by, in units of a delta action.

        Raises:
            TrainingError: the expert fails too often.
        """
        acting: SimEnv = NoisyEnv(self.env, noise) if noise > 0 else self.env
        n_kept, n_tried = 0, 0
        while n_kept < n:
            if n_tried >= ENOUGH_TRIES * n + self.n_slots:
                raise TrainingError(
                    f"{self.env.spec.task}: the expert succeeded in {n_kept} of {n_tried} episodes, and {n} "
                    "demonstrations are asked for. Lower train_agent.arguments.action_noise, or take the "
                    "control mode in which it was made (--set env.control_mode=pd_ee_delta_pose)."
                )
            found = self._batch(acting, n_tried)[: n - n_kept]
            n_kept, n_tried = n_kept + len(found), n_tried + self.n_slots
            yield found

    def _batch(self, acting: SimEnv, first: int) -> list[Demonstration]:
        logs = _Logs()
        starts = [self._start(slot, first + slot) for slot in range(self.n_slots)]
        settings = RolloutSettings(chunking=ONE_BY_ONE, stop_at_success=not self.is_base)
        records = rollout(acting, self.policy, starts, settings, observers=[logs])
        kept = [record.success_once or self.is_base for record in records]
        return [self._read(logs.of_slot[slot]) for slot, is_kept in enumerate(kept) if is_kept]

    def _start(self, slot: int, number: int) -> EpisodeStart:
        drawn = generator(self.run_seed, Stream.AGENT, DEMONSTRATION, DEMONSTRATION, number)
        spec = self.env.spec
        return EpisodeStart(
            slot=slot,
            task=spec.task,
            seed=int(drawn.integers(TRAINING_SEEDS.start, TRAINING_SEEDS.stop)),
            run=0,
            instruction=self.instruction,
            horizon_steps=spec.horizon_steps,
        )

    def _read(self, log: EpisodeLog) -> Demonstration:
        seen = [as_inputs(self.reader.read(result.observation)) for result in log.results[:-1]]
        actions: FloatArray = np.stack(log.asked).astype(np.float32)
        if self.env.spec.action.control_mode == DISCRETE:
            actions = actions - np.array(self.env.spec.action.low, np.float32)  # choices count from 0
        return Demonstration(np.stack(seen), actions, touched_next(log.results))


def touched_next(results: Sequence[StepResult]) -> NDArray[np.int64]:
    """Return (T,) of the T + 1 results of an episode: the candidate in view that is touched next.

    Hindsight alone: what the demonstration shows later. -1 before the response, after the last touch, and for
    tasks without candidates.
    """
    touched = [result.status.touched_candidates or () for result in results]
    in_view = [result.status.phase == "response" for result in results]
    return np.array(
        [
            touched[-1][len(before)] if is_seen and len(before) < len(touched[-1]) else -1
            for before, is_seen in zip(touched[:-1], in_view[:-1], strict=True)
        ],
        np.int64,
    )


def order(run_seed: int, pass_number: int, n: int) -> np.ndarray[Any, Any]:
    """Return in which order `n` demonstrations are read in a pass."""
    return generator(run_seed, Stream.AGENT, DEMONSTRATION, ORDER, pass_number).permutation(n)


def exchanges(
    run_seed: int, step: int, *, n_demonstrations: int, n_candidates: int, share: float
) -> np.ndarray[Any, Any]:
    """Return how candidates are exchanged at a gradient step, (demonstrations, candidates).

    Candidate i of a demonstration becomes what candidate `[i]` is there; `share` of the demonstrations do so.
    """
    drawn = generator(run_seed, Stream.AGENT, DEMONSTRATION, EXCHANGE, step)
    as_they_are = np.tile(np.arange(n_candidates), (n_demonstrations, 1))
    is_exchanged = drawn.random(n_demonstrations) < share
    return np.where(is_exchanged[:, None], drawn.permuted(as_they_are, axis=1), as_they_are)
