"""Sort episodes of run folders into the rows of one table: never across settings, none counted twice."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from vla_eval.records import EpisodeRecord
from vla_eval.results.passport.settings import variant_labels
from vla_eval.storage.planned import bare_name, bare_task, parts_of
from vla_eval.storage.run_file import JsonValue
from vla_eval.storage.run_folder import StoredRun

POLICY_NAMES = "policy_names"  # the policies' names in records, in the configuration of a run
WEIGHTS = "checkpoints/"  # recipes whose names have this prefix are the weights of a policy
BASE = "base"  # after the policy's name: the base checkpoint of its adapter


class RowKey(NamedTuple):
    """The key that all episodes of a row share."""

    task: str
    policy: str
    n_action_steps: int
    variant: str | None

    @property
    def place(self) -> str:
        """What is the same for all policies: `RememberColor3-v0 K=4 (env.delay_steps=10)`."""
        variant = f" ({self.variant})" if self.variant else ""
        return f"{self.task} K={self.n_action_steps}{variant}"

    @property
    def of_all_tasks(self) -> "RowKey":
        """The key that rows of one policy on several tasks share."""
        return self._replace(task="")

    def __str__(self) -> str:
        """Return `oracle on RememberColor3-v0 K=4`."""
        return f"{self.policy} on {self.place}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One independent run of a row."""

    index: int
    # 0, or 1, 2 … if further run folders hold the same episodes with other trajectories or other weights
    copy: int
    records: Mapping[int, EpisodeRecord]  # seed -> record
    # digests of the policy's weights; none for a policy without weights
    weights: frozenset[str] = frozenset()

    @property
    def results(self) -> dict[int, EpisodeRecord]:
        """Return seed -> record of all episodes that are not errors."""
        return {seed: record for seed, record in self.records.items() if record.outcome != "error"}

    @property
    def has_success(self) -> bool:
        """Whether its task has a success rule."""
        return all(record.outcome != "finished" for record in self.records.values())

    @property
    def key(self) -> tuple[int, int]:
        """What distinguishes it from the other runs of its row: index and copy."""
        return self.index, self.copy

    @property
    def n_success(self) -> int:
        """How many of its episodes succeeded."""
        return sum(record.outcome == "success" for record in self.results.values())

    @property
    def rate(self) -> float:
        """The share that succeeded, of at least one episode with a result."""
        return self.n_success / len(self.results)


@dataclass(frozen=True, slots=True, kw_only=True)
class RowEpisodes:
    """The episodes of one row."""

    key: RowKey
    runs: tuple[Run, ...]

    @property
    def runs_with_results(self) -> list[Run]:
        """The runs with an episode that is not an error."""
        return [run for run in self.runs if run.results]

    @property
    def results(self) -> list[EpisodeRecord]:
        """Return all records that are not errors."""
        return [record for run in self.runs for record in run.results.values()]

    @property
    def n_errors(self) -> int:
        """The number of episodes without a result."""
        return sum(len(run.records) - len(run.results) for run in self.runs)


@dataclass(frozen=True, slots=True, kw_only=True)
class Grouping:
    """All rows, in the order of the table."""

    groups: Mapping[RowKey, RowEpisodes]
    # run folder -> number of its episodes that an earlier folder already had
    n_doubles: Mapping[str, int]
    # run folders that hold the episodes of another folder with other trajectories or weights
    further: tuple[str, ...]
    # by key: the run folders that hold episodes of the row
    folders: Mapping[RowKey, tuple[StoredRun, ...]]


class _Copy(NamedTuple):
    """Episodes of one run index with the same weights: seed -> record."""

    weights: frozenset[str]
    records: dict[int, EpisodeRecord]


def group_runs(runs: Sequence[StoredRun]) -> Grouping:
    """Sort the episodes of all runs into rows: by task and policy as in the configurations, then by K."""
    labels = variant_labels(runs)
    found: dict[RowKey, dict[int, list[_Copy]]] = defaultdict(lambda: defaultdict(list))
    n_doubles: dict[str, int] = defaultdict(int)
    further: dict[str, None] = {}
    folders: dict[RowKey, list[StoredRun]] = defaultdict(list)
    for stored, label_of in zip(runs, labels, strict=True):
        own: dict[tuple[RowKey, int], dict[int, EpisodeRecord]] = defaultdict(dict)
        for record in stored.records:
            key = RowKey(record.task, record.policy, record.n_action_steps, label_of[record.task])
            own[key, record.run][record.seed] = record
        for (key, index), records in own.items():
            copies = found[key][index]
            if stored not in folders[key]:
                folders[key].append(stored)
            n_copies = len(copies)
            n_new = _place(copies, _Copy(_weights(stored, key, index), records))
            if n_new < len(records):
                n_doubles[str(stored.path)] += len(records) - n_new
            if 0 < n_copies < len(copies):
                further[str(stored.path)] = None
    groups = [RowEpisodes(key=key, runs=_runs(by_index)) for key, by_index in found.items()]
    return Grouping(
        groups={group.key: group for group in _in_order(groups, runs)},
        n_doubles=dict(n_doubles),
        further=tuple(further),
        folders={key: tuple(of_row) for key, of_row in folders.items()},
    )


def _weights(stored: StoredRun, key: RowKey, index: int) -> frozenset[str]:
    """Return the digests of a policy's weights in a run; none for a policy without weights."""
    parts = {f"{WEIGHTS}{part}" for part in parts_of(key.policy, task=key.task, run=index)}
    own = {*parts, *(f"{part}/{BASE}" for part in parts)}
    return frozenset(digest for name, digest in stored.description.recipes.items() if name in own)


def _runs(by_index: Mapping[int, Sequence[_Copy]]) -> tuple[Run, ...]:
    return tuple(
        Run(index=index, copy=number, records=copy.records, weights=copy.weights)
        for index, copies in sorted(by_index.items())
        for number, copy in enumerate(copies)
    )


def _place(copies: list[_Copy], found: _Copy) -> int:
    """Add one folder's episodes of one run to the right run; return how many were new.

    They belong to a known run if its policy had the same weights and they do not contradict it (the seeds
    of one run may be split over folders, and one folder may be a copy of another). Otherwise they are a
    further run.
    """
    own = found.records
    alike = [copy.records for copy in copies if copy.weights == found.weights]
    for known in alike:
        if _belongs(known, own):
            fresh = {
                seed: record
                for seed, record in own.items()
                if seed not in known or (known[seed].outcome == "error" and record != known[seed])
            }
            known.update(fresh)
            return len(fresh)
    fresh = {
        seed: record
        for seed, record in own.items()
        if not any(seed in known and _is_same(known[seed], record) for known in alike)
    }
    copies.append(_Copy(found.weights, fresh))
    return len(fresh)


def _belongs(known: Mapping[int, EpisodeRecord], own: Mapping[int, EpisodeRecord]) -> bool:
    shared = known.keys() & own.keys()
    same = [seed for seed in shared if _is_same(known[seed], own[seed])]
    if len(same) == len(shared):
        return True
    # A copy of a folder that was resumed has results where the other one has errors. Without any common
    # result it is another run, whose errors must not be hidden by this one's results.
    one_is_error = all(
        "error" in (known[seed].outcome, own[seed].outcome) for seed in shared if seed not in same
    )
    return one_is_error and any(known[seed].outcome != "error" for seed in same)


def _is_same(one: EpisodeRecord, other: EpisodeRecord) -> bool:
    if "error" in (one.outcome, other.outcome):
        return one == other
    return one.trajectory_sha256 is not None and one.trajectory_sha256 == other.trajectory_sha256


def config_names(run: StoredRun, field: str) -> tuple[str, ...]:
    """Return the tasks or policies of a run's configuration, as its records name them."""
    config = run.description.config
    # A checkpoint is given as a folder; its name in records is known once it has been read.
    names = config.get(POLICY_NAMES) if field == "policies" else None
    bare = bare_task if field == "tasks" else bare_name
    return tuple(bare(name) for name in texts_of(config.get(field) if names is None else names))


def texts_of(value: JsonValue) -> list[str]:
    """Return the items of a list in a configuration; none of what is no list."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return []
    return [str(item) for item in value]


def _in_order(groups: Sequence[RowEpisodes], runs: Sequence[StoredRun]) -> list[RowEpisodes]:
    records = [record for run in runs for record in run.records]
    tasks = _ranks(*(config_names(run, "tasks") for run in runs), (r.task for r in records))
    policies = _ranks(*(config_names(run, "policies") for run in runs), (r.policy for r in records))
    variants = _ranks(group.key.variant for group in groups)  # in the order of the run folders

    def place(key: RowKey) -> tuple[int, int, int, int]:
        return tasks[key.task], policies[key.policy], key.n_action_steps, variants[key.variant]

    return sorted(groups, key=lambda group: place(group.key))


def _ranks[N](*names: Iterable[N]) -> dict[N, int]:
    return {name: rank for rank, name in enumerate(dict.fromkeys(chain(*names)))}
