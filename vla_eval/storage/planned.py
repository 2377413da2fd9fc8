"""Which episodes a run has, by its configuration alone. Knows nothing of files."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import PurePath
from typing import Any, NamedTuple

from vla_eval.errors import some_of
from vla_eval.records import EpisodeRecord
from vla_eval.storage.shard import Shard
from vla_eval.strict.json_text import Count, Positive, Source, as_dataclass

OF_RUN = "run-"
_NAMED = re.compile(r"(?P<name>\w[\w.-]*)(?::(?P<task>\w[\w./-]*))?=(?P<checkpoints>.+)", re.DOTALL)


class NamedCheckpoints(NamedTuple):
    """What `NAME=A,B,C` says, or `NAME:TASK=A,B,C`: a policy whose runs 0, 1, 2 … are these checkpoints."""

    name: str
    checkpoints: tuple[str, ...]
    task: str | None = None

    def is_for(self, policy: str, task: str) -> bool:
        """Whether records of this policy and task are of these checkpoints."""
        own = task if self.task is None else bare_task(self.task)
        return self.name == policy and own in (task, task.rpartition("-v")[0])  # named without a version


def named_checkpoints(policy: str) -> NamedCheckpoints | None:
    """Read the entry of a policy in a configuration; None if it names a single one."""
    match = _NAMED.fullmatch(policy)
    if match is None:
        return None
    return NamedCheckpoints(match["name"], tuple(match["checkpoints"].split(",")), match["task"])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedConfig:
    """The part of a configuration that says which episodes there are; None is not known."""

    # ids, maybe with their namespace; `task_versions`: id -> version of its rules
    tasks: tuple[str, ...] | None = None
    task_versions: dict[str, int] | None = None
    # names, files, folders, `NAME=A,B,C` or `NAME:TASK=A,B,C`; `policy_names`: their names in records
    policies: tuple[str, ...] | None = None
    policy_names: tuple[str, ...] | None = None
    n_action_steps: tuple[Positive, ...] | None = None  # None also where each policy has its default
    episodes: Positive | None = None
    runs: Positive | None = None
    seed_start: Count | None = None

    def n_runs(self, policy: str, task: str) -> int | None:
        """Return how many runs a policy has on a task: one per checkpoint if it was given several."""
        named = (named_checkpoints(entry) for entry in self.policies or ())
        own = (one for one in named if one is not None and one.is_for(policy, task))
        return next((len(one.checkpoints) for one in own), self.runs)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Described:
    """So that a message says `config.episodes`."""

    config: PlannedConfig


def planned_config(config: Mapping[str, Any], source: Source) -> PlannedConfig:  # Any: JSON
    """Return the part of `config` that says which episodes there are; the other fields may be anything."""
    known = {one.name: config[one.name] for one in fields(PlannedConfig) if one.name in config}
    return as_dataclass(_Described, {"config": known}, source).config


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedEpisodes:
    """The episodes of a run: groups (task, policy, n_action_steps), where known, and the shard, if any."""

    config: PlannedConfig
    groups: Collection[tuple[str, str, int]] | None = None
    shard: Shard | None = None

    def objection(self, record: EpisodeRecord) -> str | None:
        """Return why a record is none of this run; None if it may be one."""
        config = self.config
        key, task = record.key, record.task
        tasks: Collection[str] | None = config.task_versions
        if tasks is None and config.tasks is not None:
            tasks = [bare_task(one) for one in config.tasks]
        if tasks is not None and task not in tasks:
            return f"the tasks are {some_of(tasks)}"
        if config.policy_names is not None and key.policy not in config.policy_names:
            return f"the policies are {some_of(config.policy_names)}"
        if config.n_action_steps is not None and key.n_action_steps not in config.n_action_steps:
            return f"n_action_steps are {some_of(config.n_action_steps)}"
        if self.groups is not None and key[:3] not in self.groups:
            return "no such policy is run on this task with these n_action_steps"
        n_runs = config.n_runs(key.policy, task)
        if n_runs is not None and key.run >= n_runs:
            return f"the runs are 0 to {n_runs - 1}"
        if config.episodes is not None and config.seed_start is not None:
            last = config.seed_start + config.episodes - 1
            if not config.seed_start <= key.seed <= last:
                return f"the seeds are {config.seed_start} to {last}"
            if self.shard is not None and not self.shard.holds(key.seed - config.seed_start):
                return f"the run is shard {self.shard}, and the seed is in another one"
        return None


def part_of(policy: str, *, task: str | None = None, run: int | None = None) -> str:
    """Return what `run.json` calls the checkpoint of a policy for a task and run, where it has several."""
    return "/".join((policy, *filter(None, (task, None if run is None else f"{OF_RUN}{run}"))))


def parts_of(policy: str, *, task: str, run: int) -> list[str]:
    """Return all that the checkpoint of a record may be called in `run.json`."""
    return [part_of(policy, task=one, run=number) for one in (None, task) for number in (None, run)]


def bare_name(name: str) -> str:
    """Return what records call a policy given as a file."""
    return PurePath(name).name.removesuffix(".yaml").removesuffix(".yml")


def bare_task(name: str) -> str:
    """Return what records call a task given with this package's namespace; others are part of its id."""
    return name.removeprefix("vla_eval/")
