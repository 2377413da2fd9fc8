"""How many control steps an inference takes: a number, drawn, measured here, or replayed from another run.

A simulated episode stands still while the policy thinks. The delay says how far a robot's clock would have
gone meanwhile. Except where it is measured it is data: the same episode has the same delays on any machine.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import MAX_STEPS, require

MEASURED = "measured"
N_REMEMBERED = 10
"""Of how many earlier delays the largest is expected next; Black et al. 2025 (arXiv:2506.07339),
algorithm 1, keep such a buffer."""
_P_TOLERANCE = 1e-6

EpisodeName = tuple[str, str, int, int, int]
"""Task, policy, n_action_steps, run and seed: `EpisodeKey` as a plain tuple."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VaryingDelay:
    """A delay that differs between inferences: drawn (`steps`, `p`), or replayed from a run (`trace`)."""

    steps: tuple[int, ...] = ()  # control steps, one of which is drawn for each inference
    p: tuple[float, ...] = ()  # their probabilities; none: all alike
    trace: str | None = None  # a run folder whose records hold delays

    def __post_init__(self) -> None:
        where = "chunking.delay"
        if bool(self.steps) == (self.trace is not None):
            raise RecipeError(f"{where}: expected either steps or trace, found {self._found()}.")
        require(self.trace is None or not self.p, f"{where}.p", self.p, "none beside a trace")
        for number in self.steps:
            require(0 <= number <= MAX_STEPS, f"{where}.steps", number, f"numbers from 0 to {MAX_STEPS:,}")
        if self.p:
            is_sound = len(self.p) == len(self.steps) and min(self.p) >= 0
            require(
                is_sound and abs(math.fsum(self.p) - 1) <= _P_TOLERANCE,
                f"{where}.p",
                list(self.p),
                f"{len(self.steps)} probabilities, one per number of steps, whose sum is 1",
            )

    def _found(self) -> str:
        return "both" if self.steps else "neither"


Delay = int | Literal["measured"] | VaryingDelay


def shortest_steps(delay: Delay) -> int:
    """Return the shortest delay that can be known before the run."""
    if isinstance(delay, VaryingDelay):
        return min(delay.steps, default=0)
    return delay if isinstance(delay, int) else 0


def longest_steps(delay: Delay) -> int | None:
    """Return the longest delay; None if that is not known before the run."""
    if isinstance(delay, VaryingDelay):
        return max(delay.steps, default=None)
    return delay if isinstance(delay, int) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayTrace:
    """The delays of a run, as far as they concern one task, policy and n_action_steps."""

    episodes: Mapping[tuple[int, int], tuple[int, ...]]  # run and seed -> control steps of each inference
    pool: tuple[int, ...]  # what is drawn from where an episode is not there, or has more inferences

    @classmethod
    def narrowed(
        cls, delays: Mapping[EpisodeName, Sequence[int]], *, task: str, policy: str, n_action_steps: int
    ) -> Self:
        """Return the part of a run's delays; where a task is not there, its pool is that of the policy.

        The pool is that of the most alike episodes: of the same policy and n_action_steps on any task, of the
        same policy, or of the whole run.
        """
        wanted = (policy, n_action_steps)
        alike = (
            # Sorted: records stand in the order in which episodes ended.
            sorted(steps for name, own in delays.items() if name[1 : 1 + n] == wanted[:n] for steps in own)
            for n in (2, 1, 0)
        )
        return cls(
            episodes={name[3:]: tuple(own) for name, own in delays.items() if name[:3] == (task, *wanted)},
            pool=tuple(next(filter(None, alike), [])),
        )


@dataclass(slots=True, kw_only=True)
class EpisodeDelays:
    """The delays of one episode's inferences, in order."""

    delay: Delay
    seed: int  # of the episode: what is drawn depends on it and on the inference's number alone
    control_hz: float
    run: int = 0  # with the seed, the episode of the trace that is replayed
    trace: DelayTrace | None = None  # where the delay is replayed
    steps: list[int] = field(default_factory=list)
    """Control steps of each inference so far."""

    @property
    def expected_steps(self) -> int:
        """How many steps the next inference is expected to take, as a robot would know it beforehand."""
        if isinstance(self.delay, int):
            return self.delay
        return max(self.steps[-N_REMEMBERED:], default=longest_steps(self.delay) or 0)

    def note(self, seconds: float) -> int:
        """Return how many control steps the inference takes that took so many seconds here."""
        steps = self._steps(seconds)
        self.steps.append(steps)
        return steps

    def _steps(self, seconds: float) -> int:
        if isinstance(self.delay, int):
            return self.delay
        if not isinstance(self.delay, VaryingDelay):
            return min(math.ceil(seconds * self.control_hz), MAX_STEPS)
        index, options = len(self.steps), self.delay.steps
        if self.trace is not None:
            replayed, options = self.trace.episodes.get((self.run, self.seed), ()), self.trace.pool
            if index < len(replayed):
                return replayed[index]
        # Here and not above: most episodes draw no delay, and numpy's generators take time to import.
        from vla_eval.seeding import Stream, generator

        random = generator(self.seed, Stream.DELAY, index)
        return int(random.choice(np.array(options), p=self.delay.p or None))
