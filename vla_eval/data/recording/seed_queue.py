"""Which seeds to try and keep: the N lowest at which the expert succeeds, whatever worker tries them."""

from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass

from vla_eval.data.recording.demonstrations import Attempt
from vla_eval.data.recording.jobs import AttemptJob, TaskPlan
from vla_eval.errors import RecordingError


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """The attempts that become episodes, by seed, and those below the last of them that did not succeed."""

    kept: tuple[Attempt, ...]
    failed: tuple[Attempt, ...]

    def attempts(self) -> list[Attempt]:
        """Return all that the selection depends on, by seed."""
        return sorted((*self.kept, *self.failed), key=lambda attempt: attempt.seed)


class SeedQueue:
    """A `JobSource` of seeds to try; `known` are the attempts of earlier sessions."""

    def __init__(self, plan: TaskPlan, known: Mapping[int, Attempt]) -> None:
        self._plan, self._recipe = plan, plan.recipe
        self._known = dict(known)
        self._in_flight: set[int] = set()

    def has_next(self) -> bool:
        """Whether there is a seed to try now."""
        return self._next() is not None

    @property
    def n_kept(self) -> int:
        """How many of the known attempts are kept so far."""
        return min(self._recipe.episodes, sum(self._keeps(one) for one in self._known.values()))

    def take(self, loaded: Hashable | None, *, taken: Collection[Hashable] = ()) -> AttemptJob | None:
        """Return the next job; see `workers.JobSource`."""
        seed = self._next()
        if seed is None:
            return None
        self._in_flight.add(seed)
        return AttemptJob(plan=self._plan, seed=seed)

    def add(self, attempt: Attempt) -> None:
        """Record a seed's result."""
        self._in_flight.discard(attempt.seed)
        self._known[attempt.seed] = attempt

    def give_back(self, job: AttemptJob) -> None:
        """A seed could not be tried: it is handed out again."""
        self._in_flight.discard(job.seed)

    def selection(self) -> Selection:
        """Return what is kept, once nothing is left to try."""
        by_seed = [self._known[seed] for seed in sorted(self._known)]
        kept = [one for one in by_seed if self._keeps(one)][: self._recipe.episodes]
        last = kept[-1].seed if kept else self._recipe.seed_start
        failed = [one for one in by_seed if not self._keeps(one) and one.seed < last]
        return Selection(kept=tuple(kept), failed=tuple(failed))

    def _keeps(self, one: Attempt) -> bool:
        return self._recipe.keep == "all" or one.success_step is not None

    def _next(self) -> int | None:
        n_hopeful = 0
        for seed in range(self._recipe.seed_start, self._recipe.last_seed + 1):
            if n_hopeful >= self._recipe.episodes:
                return None
            if seed in self._in_flight:
                n_hopeful += 1
            elif seed in self._known:
                n_hopeful += self._keeps(self._known[seed])
            else:
                return seed
        if self._in_flight or n_hopeful >= self._recipe.episodes:
            return None
        raise RecordingError(
            f"the expert '{self._recipe.expert}' succeeded at {n_hopeful} of the "
            f"{self._recipe.last_seed - self._recipe.seed_start + 1} seeds from {self._recipe.seed_start} to "
            f"{self._recipe.last_seed}; {self._recipe.episodes} episodes are wanted. Allow more with "
            f"max_failed_seeds, ask for fewer episodes, or lower action_noise."
        )
