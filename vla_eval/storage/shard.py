"""Which part of a plan a run has: one of several disjoint shards, which `mikasa-vla merge` puts together.

The plan alone decides. Blocks of consecutive seeds are dealt out in turn: block 0 to shard 1, block 1 to
shard 2 …. A seed's episodes are all in one shard, of every task, policy and run, so that pairs stay together.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from vla_eval.errors import RecipeError
from vla_eval.strict.json_text import Positive

WRITTEN = re.compile(r"(\d{1,6})/(\d{1,6})", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """One of `count` disjoint parts."""

    number: Positive  # from 1
    count: Positive
    block_size: Positive = 1  # consecutive episodes that stay together, since they run side by side
    # (task, policy, n_action_steps) of all episodes of the plan, in its order
    groups: tuple[tuple[str, str, Positive], ...] = ()

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `3/8`; raise `RecipeError` if there is no such shard."""
        match = WRITTEN.fullmatch(text)
        if match is None:
            raise RecipeError(
                f"expected the number of a shard and how many there are, such as 3/8, found '{text:.40}'."
            )
        number, count = int(match[1]), int(match[2])
        if not 1 <= number <= count:
            raise RecipeError(f"expected a number from 1 to that of all shards, 1/8 to 8/8, found '{text}'.")
        return cls(number=number, count=count)

    def __str__(self) -> str:
        """Return `3/8`."""
        return f"{self.number}/{self.count}"

    def holds(self, index: int) -> bool:
        """Whether the episode of this index, from 0, is in this shard."""
        return index // self.block_size % self.count == self.number - 1

    def indices(self, n_episodes: int) -> tuple[int, ...]:
        """Return which of the first `n_episodes` are in this shard."""
        return tuple(index for index in range(n_episodes) if self.holds(index))

    def of_blocks(self, block_size: int, n_episodes: int) -> Self:
        """Return this shard with its block size; raise `RecipeError` if it would have no episode."""
        n_blocks = -(-n_episodes // block_size)
        if self.count > n_blocks:
            beside = f", {block_size} of which stay together" if block_size > 1 else ""
            raise RecipeError(
                f"--shard {self}: expected at most {n_blocks} shards, since there are {n_episodes} "
                f"episodes{beside}. Use fewer shards."
            )
        return replace(self, block_size=block_size)


def shard_folder(out: Path, shard: Shard | None) -> Path:
    """Return the sibling of `out` that a shard goes to, `out-shard-3-of-8`; `out` itself without one."""
    if shard is None:
        return out
    named = out if out.name not in ("", "..") else out.resolve()
    return named.with_name(f"{named.name}-shard-{shard.number}-of-{shard.count}")
