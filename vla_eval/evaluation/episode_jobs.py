"""What one episode of a plan is: the row of a table that it belongs to, and what a worker needs to run it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from vla_eval.config.environment import EnvSettings
from vla_eval.memory_change import MemoryChange
from vla_eval.records import EpisodeKey
from vla_eval.rollout import RolloutSettings
from vla_eval.specs import EnvSpec


class GroupKey(NamedTuple):
    """The row of a table that episodes belong to."""

    task: str
    policy: str
    n_action_steps: int


class SetupKey(NamedTuple):
    """The key of episodes that one environment object and one policy object can run."""

    group: GroupKey
    checkpoint: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeGroup:
    """Episodes that differ only in run and seed."""

    key: GroupKey
    adapter: str  # registry name of the policy's code
    # the adapter's keyword arguments
    args: Mapping[str, Any]  # Any: whatever the adapter takes
    env: EnvSettings  # the environment, before it is known which cameras the policy needs
    offered: EnvSpec  # what that environment provides, known without making it
    n_candidates: int  # what the task lets one choose among; 0 where nothing is chosen
    rollout: RolloutSettings
    instruction: str
    memory_change: MemoryChange | None = None  # what is changed of the policy's memory
    # how many episodes a forward pass of the policy has room for: the slots of a worker where the policy
    # is in it, else what its server says
    n_rows: int = 1
    # of a policy of several checkpoints, which one; it has the run of that number alone
    checkpoint: int | None = None
    # the policy's name in recipes and among shared policies; with several checkpoints, that of one
    part: str = ""

    @property
    def setup_key(self) -> SetupKey:
        """Episodes with the same one can be run with the same environment and policy."""
        return SetupKey(self.key, self.checkpoint)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeJob:
    """One episode to run, its slot in a worker and its row in a forward pass, both fixed by the seed."""

    group: EpisodeGroup
    run: int
    seed: int
    slot: int = 0
    row: int = 0

    @property
    def key(self) -> EpisodeKey:
        """The identity of the episode within its run folder."""
        return EpisodeKey(*self.group.key, self.run, self.seed)
