"""A `workers.JobSource` of jobs that are all known from the start."""

from collections import deque
from collections.abc import Collection, Hashable, Iterable

from vla_eval.workers.jobs import Job


class JobList[J: Job]:
    """Hands out jobs in their order."""

    def __init__(self, jobs: Iterable[J]) -> None:
        """Take the jobs."""
        self._jobs = deque(jobs)

    def has_next(self) -> bool:
        """Whether there is a job that has not been handed out."""
        return bool(self._jobs)

    def take(self, loaded: Hashable | None, *, taken: Collection[Hashable] = ()) -> J | None:
        """Return the next job; see `workers.JobSource`."""
        return self._jobs.popleft() if self._jobs else None

    def give_back(self, job: J) -> None:
        """Hand out a job again, next."""
        self._jobs.appendleft(job)
