"""What a policy adapter gets when it is made: the one signature all adapters share."""

from dataclasses import dataclass

from vla_eval.chunking import ChunkingSpec
from vla_eval.specs import EnvSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyContext:
    """The first argument of every policy factory; the recipe's `args` follow as keyword arguments.

    Attributes:
        name: the policy's name in records and tables.
        env: what the environment offers.
        chunking: how its chunks will be executed; a scripted policy plans `min_chunk_size` actions.
        n_candidates: how many candidates the task has; 0 for a task without candidates.
        n_slots: how many episodes will run side by side, in slots 0 … n_slots - 1.
    """

    name: str
    env: EnvSpec
    chunking: ChunkingSpec
    n_candidates: int
    n_slots: int = 1
