"""`meta/mikasa/mixture.json`: of which datasets one for several tasks was made. Knows nothing of lerobot."""

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from vla_eval.data.facts_file import FactsFile
from vla_eval.data.manifest import MIXTURE_FILE, FileDigest
from vla_eval.seeding import SeedRange, seed_ranges
from vla_eval.strict.json_text import Count, Positive

FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class MixtureSource:
    """A dataset of one task, whose episodes follow those of the sources before it.

    Attributes:
        name: its folder's name.
        task: task id; None for an import that names none.
        task_version: of the task's rules; None for an import.
        instructions: every sentence that occurs in it.
        n_episodes, n_frames: counts.
        sha256: digest of the digests of all its files.
        seeds: of its episodes, in their order; None for an import, whose seeds are not ours.
        failed_seeds: at which the expert did not succeed.
        was_replayed: whether a replay had confirmed it when it was mixed.
    """

    name: str
    task: str | None
    task_version: Positive | None
    instructions: tuple[str, ...]
    n_episodes: Positive
    n_frames: Positive
    sha256: str
    seeds: tuple[Count, ...] | None
    failed_seeds: tuple[Count, ...]
    was_replayed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class MixtureFacts:
    """What a dataset of several tasks is; its presence with `complete` marks it as finished.

    Attributes:
        complete: written as true, after everything else.
        state: which proprioception `observation.state` is.
        control_mode: what the actions are for.
        sources: in the order of their episodes.
        files: path below the dataset -> digest.
        vla_eval_version: what mixed it.
    """

    complete: bool
    state: str
    control_mode: str
    sources: tuple[MixtureSource, ...]
    files: dict[str, FileDigest]
    vla_eval_version: str

    @property
    def tasks(self) -> tuple[str, ...]:
        """The task ids, each once, in the order of the sources."""
        return tuple(dict.fromkeys(one.task for one in self.sources if one.task is not None))

    @property
    def task(self) -> str | None:
        """The task of all sources; None if they are of several, or one names none."""
        named = {one.task for one in self.sources}
        return self.sources[0].task if len(named) == 1 else None

    @property
    def seeds(self) -> dict[str, tuple[SeedRange, ...]] | None:
        """Task -> the seeds of its episodes, as far as they are known; None if none are."""
        known: dict[str, list[int]] = {}
        for one in self.sources:
            if one.task is not None and one.seeds is not None:
                known.setdefault(one.task, []).extend(one.seeds)
        return {task: seed_ranges(own) for task, own in known.items()} or None

    @property
    def shared_scenes(self) -> tuple[str, ...]:
        """A sentence for each two sources that have seeds of one task's rules in common: the same scenes."""
        found = []
        for one, other in combinations(self.sources, 2):
            if one.task is None or (one.task, one.task_version) != (other.task, other.task_version):
                continue
            common = sorted(set(one.seeds or ()) & set(other.seeds or ()))
            if common:
                found.append(
                    f"{one.name} and {other.name} share {len(common)} seeds of {one.task}, from "
                    f"{common[0]} to {common[-1]}: these scenes count twice."
                )
        return tuple(found)

    @property
    def n_frames(self) -> int:
        """Of all sources."""
        return sum(one.n_frames for one in self.sources)

    @property
    def was_replayed(self) -> bool:
        """Whether a replay had confirmed every source."""
        return all(one.was_replayed for one in self.sources)


_FILE = FactsFile(
    cls=MixtureFacts,
    path=MIXTURE_FILE,
    version=FORMAT_VERSION,
    what="of which datasets one was mixed",
    made_by="the mixing",
    remedy="mix the sources again.",
)


def write_mixture(dataset: Path, facts: MixtureFacts) -> None:
    """Write `mixture.json`, whole or not at all."""
    _FILE.write(dataset, facts)


def read_mixture(dataset: Path) -> MixtureFacts | None:
    """Return of what a dataset was mixed; None if it was not.

    Raises:
        DatasetError: the file is damaged, of another version, or the mixing did not finish.
    """
    return _FILE.read(dataset)
