"""What a policy adapter gets when it is made: the one signature all adapters share."""

from dataclasses import dataclass

from vla_eval.chunking import ChunkingSpec
from vla_eval.specs import EnvSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyContext:
    """The first argument of every policy factory; the recipe's `args` follow as keyword arguments.

    A scripted policy plans chunks of `chunking.min_chunk_size`; a task without candidates has 0; slots are
    0 … n_slots - 1.
    """

    name: str
    env: EnvSpec
    chunking: ChunkingSpec
    n_candidates: int
    n_slots: int = 1
