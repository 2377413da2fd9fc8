"""The footnotes of a table on its run folders: what is missing, counted once, or not the same in all."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

from vla_eval.errors import MAX_NAMED, some_of
from vla_eval.results.grouping import Grouping, config_names, texts_of
from vla_eval.results.own_statistics import count
from vla_eval.results.passport.settings import differing_environment, differing_recipes
from vla_eval.storage.planned import named_checkpoints
from vla_eval.storage.run_file import JsonValue
from vla_eval.storage.run_folder import StoredRun
from vla_eval.storage.trained_on import seen_in_training
from vla_eval.tasks.catalog import find_task

UNCOMMITTED = "made with uncommitted changes to the package, which the commit does not contain."


class PlannedRow(NamedTuple):
    """A group of episodes in a configuration; without `n_action_steps`: the policy's default."""

    task: str
    policy: str
    n_action_steps: int | None

    def __str__(self) -> str:
        """Return `oracle on RememberColor3-v0 K=4`."""
        k = "" if self.n_action_steps is None else f" K={self.n_action_steps}"
        return f"{self.policy} on {self.task}{k}"


def run_notes(runs: Sequence[StoredRun], grouping: Grouping) -> list[str]:
    """Return the notes on the run folders."""
    notes = [(str(run.path), note) for run in runs for note in (*_no_evidence(run), *_unknown_weights(run))]
    doubles = "with the same trajectory as in another run folder; each is counted once."
    notes += [(path, f"{count(n, 'episode')} {doubles}") for path, n in grouping.n_doubles.items()]
    further = (
        "repeats episodes of another run folder (same run and seed) with other trajectories or weights; they "
        "count as further runs."
    )
    notes += [(path, further) for path in grouping.further]
    own = [f"{name}: another checkpoint for each task." for name in _by_task(runs)]
    for run in runs:
        seen = seen_in_training((record.key for record in run.records), run.description.training_seeds)
        own += [*_incomplete(run), *_continued_elsewhere(run), *seen]
    sentences = dict.fromkeys(line for run in runs for session in run.sessions for line in session.sentences)
    return [*_told_together(notes), *own, *sentences, *_absent_shards(runs), *_differences(runs)]


def _by_task(runs: Sequence[StoredRun]) -> list[str]:
    """Return the policies that have checkpoints for single tasks."""
    entries = [one for run in runs for one in texts_of(run.description.config.get("policies"))]
    named = [named_checkpoints(one) for one in entries]
    return list(dict.fromkeys(one.name for one in named if one is not None and one.task is not None))


def _told_together(notes: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Yield one note for many folders; a few are named individually."""
    paths_of: dict[str, list[str]] = {}
    for path, note in notes:
        paths_of.setdefault(note, []).append(path)
    for note, paths in paths_of.items():
        if len(paths) > MAX_NAMED:
            yield f"{paths[0]} and {len(paths) - 1} more run folders: {note}"
        else:
            yield from (f"{path}: {note}" for path in paths)


def _unknown_weights(run: StoredRun) -> Iterator[str]:
    """Name the policies behind sockets whose servers do not say which weights they have."""
    unknown = [
        name
        for name, server in run.description.servers.items()
        if not (isinstance(server, Mapping) and "weights_sha256" in server)
    ]
    if unknown:
        yield (
            f"weights unknown: the server of {some_of(unknown)} does not say which weights the policy has, "
            "so that no change of them would be noticed."
        )


def _no_evidence(run: StoredRun) -> Iterator[str]:
    """Say what makes the results of a run meaningless or impossible to reproduce."""
    if run.description.config.get("simulator") == "fake":
        yield "made with the fake simulator, which has no physics; its rates mean nothing."
    if has_uncommitted_changes(run.description.environment):
        yield UNCOMMITTED


def has_uncommitted_changes(environment: Mapping[str, JsonValue]) -> bool:
    """Return whether a run was made with another code than that of its commit."""
    source = environment.get("vla_eval")
    return isinstance(source, Mapping) and source.get("changes") is not None


def _incomplete(run: StoredRun) -> Iterator[str]:
    config = run.description.config
    n_episodes, n_runs = config.get("episodes"), config.get("runs", 1)
    if not isinstance(n_episodes, int) or not isinstance(n_runs, int):
        return
    there: Counter[PlannedRow] = Counter(PlannedRow(r.task, r.policy, r.n_action_steps) for r in run.records)
    shard = run.description.shard
    expected = (n_episodes if shard is None else len(shard.indices(n_episodes))) * n_runs
    missing = {group: there[group] for group in _planned(run, there) if there[group] < expected}
    parts = (f"{group}: {n} of {expected}" for group, n in missing.items())
    if missing:
        yield (
            f"{run.path} is incomplete (episodes done, of how many): {some_of(parts)}. Run the same command "
            "again to resume."
        )


def _absent_shards(runs: Sequence[StoredRun]) -> Iterator[str]:
    """Name the shards of a run that are not among the run folders."""
    found: dict[tuple[str, int], set[int]] = defaultdict(set)
    for run in runs:
        if run.description.shard is not None:
            found[run.description.name, run.description.shard.count].add(run.description.shard.number)
    for (name, n_shards), numbers in found.items():
        absent = [f"{n}/{n_shards}" for n in range(1, n_shards + 1) if n not in numbers]
        if absent:
            yield f"{name} is not complete; not in this table: shard {some_of(absent)}."


def _planned(run: StoredRun, there: Mapping[PlannedRow, int]) -> list[PlannedRow]:
    """Return all groups that have episodes, and those of the configuration that have none."""
    steps = run.description.config.get("n_action_steps")
    begun_pairs = {(group.task, group.policy) for group in there}
    begun_policies = {group.policy for group in there}
    named: list[PlannedRow] = []
    for task, policy in product(config_names(run, "tasks"), config_names(run, "policies")):
        has_none = (spec := find_task(task)) is not None and not spec.has_candidates
        if (task, policy) not in begun_pairs and policy in begun_policies and has_none:
            continue  # a policy that needs candidates is skipped there; nothing is missing
        if isinstance(steps, Sequence) and not isinstance(steps, str):
            named += [PlannedRow(task, policy, k) for k in steps if isinstance(k, int)]
        elif (task, policy) not in begun_pairs:
            named.append(PlannedRow(task, policy, None))
    return list(dict.fromkeys((*named, *there)))


def _continued_elsewhere(run: StoredRun) -> Iterator[str]:
    changed = dict.fromkeys(one.path for session in run.sessions for one in session.environment_changes)
    if changed:
        yield (
            f"{run.path} was resumed in another environment (--allow-environment-change); what changed: "
            f"{some_of(changed)}."
        )


def _differences(runs: Sequence[StoredRun]) -> Iterator[str]:
    """Name what differs between the passports of the run folders beyond their settings."""
    environment, recipes = differing_environment(runs), differing_recipes(runs)
    if environment:
        yield f"the run folders were made in different environments; what differs: {some_of(environment)}."
    if recipes:
        yield (
            f"the run folders were made with different contents of {some_of(recipes)}; rows of the same "
            "name are combined anyway."
        )
