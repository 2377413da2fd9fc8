"""Jobs, where they come from and how they end. Knows neither processes nor machines."""

from collections import deque
from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from vla_eval.storage.run_file import JsonValue
from vla_eval.workers.messages import Failed, Notice


class Job(Protocol):
    """What a worker can be given to do; it is sent to it by pickle."""

    @property
    def setup_key(self) -> Hashable:
        """Jobs with the same one need the same preparation, which a process keeps; others get their own."""

    @property
    def n_items(self) -> int:
        """How many of what progress counts it has: the episodes of a batch, for example."""
        return 1


class JobSource[J: Job](Protocol):
    """A source of jobs; `JobQueue` is one."""

    def has_next(self) -> bool:
        """Whether a job can be handed out now."""

    def take(self, loaded: Hashable | None, *, taken: Collection[Hashable]) -> J | None:
        """Return the next job for a worker that has loaded `loaded`, while others have `taken`."""


class JobList[J: Job]:
    """A `JobSource` of jobs that are all known from the start; it hands them out in their order."""

    def __init__(self, jobs: Iterable[J]) -> None:
        self._jobs = deque(jobs)

    def has_next(self) -> bool:
        """Whether there is a job that has not been handed out."""
        return bool(self._jobs)

    def take(self, loaded: Hashable | None, *, taken: Collection[Hashable] = ()) -> J | None:
        """Return the next job; see `JobSource`."""
        return self._jobs.popleft() if self._jobs else None

    def give_back(self, job: J) -> None:
        """Hand out a job again, next."""
        self._jobs.appendleft(job)


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineKind:
    """What kind of machine a worker ran on: its name, and what bits may depend on."""

    name: str
    facts: Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered[J: Job, A]:
    """The result of one job; `kind` is that of the machine; None: the same as the planning machine."""

    job: J
    answer: A | Failed
    kind: MachineKind | None = None


type Event[J: Job, A] = Answered[J, A] | Notice | None
"""What a pool yields: an answer, a notice, or None on every tick."""
