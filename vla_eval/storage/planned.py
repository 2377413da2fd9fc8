"""Which episodes a run has, by its configuration: what else is in its folder is not counted.

Knows nothing of files.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import PurePath
from typing import Any, NamedTuple

from vla_eval.errors import some_of
from vla_eval.records import EpisodeRecord
from vla_eval.storage.shard import Shard
from vla_eval.strict.json_text import Count, Positive, Source, as_dataclass

_NAMED = re.compile(r"(?P<name>\w[\w.-]*)=(?P<checkpoints>.+)", re.DOTALL)


class NamedCheckpoints(NamedTuple):
    """What `NAME=A,B,C` says: one policy whose runs are different checkpoints.

    Attributes:
        name: of the policy in records and tables.
        checkpoints: of run 0, 1, 2 …
    """

    name: str
    checkpoints: tuple[str, ...]


def named_checkpoints(policy: str) -> NamedCheckpoints | None:
    """Read the entry of a policy in a configuration; None if it names a single one."""
    match = _NAMED.fullmatch(policy)
    return NamedCheckpoints(match["name"], tuple(match["checkpoints"].split(","))) if match else None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedConfig:
    """The part of a configuration that says which episodes there are; None is not known.

    Attributes:
        tasks: ids, maybe with their namespace.
        task_versions: task id -> version of its rules.
        policies: names, files or folders, or `NAME=A,B,C`.
        policy_names: what records call the policies.
        n_action_steps: None also where each policy has its default.
        episodes, runs, seed_start: how many, and of which seeds.
    """

    tasks: tuple[str, ...] | None = None
    task_versions: dict[str, int] | None = None
    policies: tuple[str, ...] | None = None
    policy_names: tuple[str, ...] | None = None
    n_action_steps: tuple[Positive, ...] | None = None
    episodes: Positive | None = None
    runs: Positive | None = None
    seed_start: Count | None = None

    def n_runs(self, policy: str) -> int | None:
        """Return how many runs a policy has: one per checkpoint if it was given several."""
        named = (named_checkpoints(entry) for entry in self.policies or ())
        return next((len(one.checkpoints) for one in named if one and one.name == policy), self.runs)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Described:
    """So that a message says `config.episodes`."""

    config: PlannedConfig


def planned_config(config: Mapping[str, Any], source: Source) -> PlannedConfig:  # Any: JSON
    """Return the part of `config` that says which episodes there are; the other fields may be anything.

    Raises:
        VlaEvalError: of `source.error`: a field has another type.
    """
    known = {one.name: config[one.name] for one in fields(PlannedConfig) if one.name in config}
    return as_dataclass(_Described, {"config": known}, source).config


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedEpisodes:
    """The episodes of a run.

    Attributes:
        config: what the configuration says of them.
        groups: (task, policy, n_action_steps) of all, where that is known.
        shard: the part of these episodes that the run has; None: all.
    """

    config: PlannedConfig
    groups: Collection[tuple[str, str, int]] | None = None
    shard: Shard | None = None

    def objection(self, record: EpisodeRecord) -> str | None:
        """Return why a record is none of this run; None if it may be one."""
        config = self.config
        key, task = record.key, record.task
        tasks = _known(config.task_versions, config.tasks)
        if tasks is not None and task not in tasks:
            return f"the tasks are {some_of(tasks)}"
        if config.policy_names is not None and key.policy not in config.policy_names:
            return f"the policies are {some_of(config.policy_names)}"
        if config.n_action_steps is not None and key.n_action_steps not in config.n_action_steps:
            return f"n_action_steps are {some_of(config.n_action_steps)}"
        if self.groups is not None and key[:3] not in self.groups:
            return "no such policy is run on this task with these n_action_steps"
        n_runs = config.n_runs(key.policy)
        if n_runs is not None and key.run >= n_runs:
            return f"the runs are 0 to {n_runs - 1}"
        if config.episodes is not None and config.seed_start is not None:
            last = config.seed_start + config.episodes - 1
            if not config.seed_start <= key.seed <= last:
                return f"the seeds are {config.seed_start} to {last}"
            if self.shard is not None and not self.shard.holds(key.seed - config.seed_start):
                return f"the run is shard {self.shard}, and the seed is in another one"
        return None


def bare_name(name: str) -> str:
    """Return what records call a policy given as a file."""
    return PurePath(name).name.removesuffix(".yaml").removesuffix(".yml")


def bare_task(name: str) -> str:
    """Return what records call a task given with this package's namespace; others are part of its id."""
    return name.removeprefix("vla_eval/")


def _known(versions: Mapping[str, int] | None, tasks: Collection[str] | None) -> Collection[str] | None:
    if versions is not None:
        return versions
    return None if tasks is None else [bare_task(task) for task in tasks]
