"""One row of another program's results, and its passport."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from vla_eval.errors import ReportError
from vla_eval.results.estimates import Interval, wilson_interval
from vla_eval.results.passport.fields import FIELDS
from vla_eval.results.passport.passport import Passport, seeds_text
from vla_eval.seeding import seed_ranges
from vla_eval.strict.json_text import Source

ANY_STEP, LAST_STEP = "success at any step", "success at the last step"
TOLERANCE = 1e-4  # of a rate that another program wrote; allenai's harness rounds to four digits


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportedRow:
    """What one policy did on one task, as another program counted it. None is what its file does not say."""

    program: str  # and its version, where the file says it
    file: str
    task: str
    policy: str | None
    n_success: int
    n_episodes: int  # with a result
    n_errors: int = 0  # episodes that ended in an error, which are no failures here
    seeds: Sequence[int] | None = None
    stated: Mapping[str, str | None] = field(default_factory=dict)  # field of a passport -> value
    perhaps: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def rate(self) -> float:
        """The share of episodes with a result that succeeded; there is at least one."""
        return self.n_success / self.n_episodes

    @property
    def interval(self) -> Interval:
        """Its 95 % Wilson interval, from the counts."""
        found = wilson_interval(self.n_success, self.n_episodes)
        assert found is not None  # there is an episode
        return found

    @property
    def passport(self) -> Passport:
        """What the file states of how the figure was made."""
        seeds = None if self.seeds is None else seeds_text(seed_ranges(self.seeds))
        own = {"seeds": seeds, "episodes": str(self.n_episodes), **self.stated}
        return Passport(
            subject=f"{self.policy or self.file} on {self.task} ({self.program})",
            origin=self.file,
            values={one.name: (own.get(one.name),) for one in FIELDS},
            perhaps=self.perhaps,
        )


def check_rate(stated: float, n_success: int, n_episodes: int, source: Source, *, what: str) -> None:
    """Refuse a file whose own rate is not that of its episodes; `stated` is from 0 to 1."""
    counted = n_success / n_episodes
    if abs(stated - counted) > TOLERANCE:
        raise source.refuse(f"{what} {stated:g}", f"its episodes are {n_success} of {n_episodes}")


def check_some(n_episodes: int, source: Source, *, of: str) -> None:
    """Refuse a task without an episode that has a result."""
    if n_episodes == 0:
        raise ReportError(f"{source.where}: {of}: no episode has a result. There is nothing to import.")
