"""Choose the episodes that a worker gets next. Knows nothing of processes or results."""

from collections import deque
from collections.abc import Collection, Hashable, Iterable
from dataclasses import dataclass

from vla_eval.evaluation.episode_jobs import EpisodeGroup, EpisodeJob, SetupKey
from vla_eval.records import EpisodeKey


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeBatch:
    """Episodes of one group that a worker runs side by side, each in a slot of its own; never empty."""

    jobs: tuple[EpisodeJob, ...]

    @property
    def group(self) -> EpisodeGroup:
        """What the episodes share."""
        return self.jobs[0].group

    @property
    def setup_key(self) -> SetupKey:
        """Batches with the same one can be run with the same environment and policy."""
        return self.group.setup_key

    @property
    def n_items(self) -> int:
        """Its episodes."""
        return len(self.jobs)


class JobQueue:
    """Hands out episodes so that mistakes appear early and few processes start.

    The first batch of each group that has no result yet comes before all others: an error of the last
    policy of the list appears in the first minutes. After that a worker stays with the group that its
    process has loaded, because another one costs a process. Neither the order nor the batches change a
    result: an episode's slot is the plan's.
    """

    def __init__(self, jobs: Iterable[EpisodeJob], *, finished: Collection[EpisodeKey]) -> None:
        jobs = tuple(jobs)
        begun = {job.group.setup_key for job in jobs if job.key in finished}
        self._heads: deque[EpisodeBatch] = deque()
        self._rest: dict[SetupKey, deque[EpisodeBatch]] = {}
        for batch in _batches(job for job in jobs if job.key not in finished):
            if batch.setup_key not in begun:
                begun.add(batch.setup_key)
                self._heads.append(batch)
            else:
                self._rest.setdefault(batch.setup_key, deque()).append(batch)

    def has_next(self) -> bool:
        """Whether there is a batch that has not been handed out."""
        return bool(self._heads) or any(self._rest.values())

    @property
    def n_batches(self) -> int:
        """How many batches have not been handed out."""
        return len(self._heads) + sum(len(batches) for batches in self._rest.values())

    @property
    def n_episodes(self) -> int:
        """How many episodes have not been handed out."""
        return sum(len(batch.jobs) for batches in (self._heads, *self._rest.values()) for batch in batches)

    def take(self, loaded: Hashable | None, *, taken: Collection[Hashable] = ()) -> EpisodeBatch | None:
        """Return the next batch for a worker, or None; preferably of a group that no other has loaded."""
        if self._heads:  # of several of one group, as `put_back_alone` leaves them, the worker keeps on
            index = next((i for i, batch in enumerate(self._heads) if batch.setup_key == loaded), 0)
            head = self._heads[index]
            del self._heads[index]
            return head
        waiting = [key for key, batches in self._rest.items() if batches]
        if not waiting:
            return None
        free = [key for key in waiting if key not in taken]
        chosen = next((key for key in waiting if key == loaded), (free or waiting)[0])
        return self._rest[chosen].popleft()

    def put_back_alone(self, batch: EpisodeBatch) -> None:
        """Queue the episodes of a batch that failed again, one by one, to find the one that fails."""
        self._heads.extendleft(EpisodeBatch(jobs=(job,)) for job in reversed(batch.jobs))


def _batches(jobs: Iterable[EpisodeJob]) -> Iterable[EpisodeBatch]:
    """Yield the jobs in their order; a batch ends with its group, or where a slot is needed twice."""
    batch: list[EpisodeJob] = []
    for job in jobs:
        is_other = bool(batch) and job.group.setup_key != batch[0].group.setup_key
        if batch and (is_other or job.slot in {other.slot for other in batch}):
            yield EpisodeBatch(jobs=tuple(batch))
            batch = []
        batch.append(job)
    if batch:
        yield EpisodeBatch(jobs=tuple(batch))
