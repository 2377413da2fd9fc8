"""What a policy adapter gets when it is made: the one signature all adapters share."""

from dataclasses import dataclass

from vla_eval.chunking import ChunkingSpec
from vla_eval.specs import EnvSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyContext:
    """The first argument of every policy factory; the recipe's `args` follow as keyword arguments."""

    name: str  # in records and tables
    env: EnvSpec  # what the environment offers
    chunking: ChunkingSpec  # how its chunks are executed; a scripted policy plans `min_chunk_size` actions
    n_candidates: int  # of the task; 0 for a task without candidates
    n_slots: int = 1  # how many episodes run side by side, in slots 0 … n_slots - 1
