"""Random generators that depend on an episode's seed and a purpose, and on nothing else.

One generator per (episode seed, purpose): what one purpose draws cannot shift what another one gets,
and neither batch size, device, order of episodes nor global random state plays a part.
"""

import contextlib
import hashlib
import random
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """The purposes. The numbers are part of every result: never renumber, only add."""

    ROBOT = 1
    TARGET = 2
    LAYOUT = 3
    PERMUTATION = 4
    PHASES = 5
    MOTION = 6
    POLICY = 7
    NOISE = 8
    DISTRACTOR = 9
    SHUFFLE = 10
    AGENT = 11
    DELAY = 12
    MEMORY = 13
    CLUTTER = 14
    REAL_PLAN = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class SeedRange:
    """All seeds from `first` to `last`."""

    first: int
    last: int

    def __contains__(self, seed: int) -> bool:
        return self.first <= seed <= self.last


def seed_ranges(seeds: Iterable[int]) -> tuple[SeedRange, ...]:
    """Return the fewest ranges that hold exactly these seeds, in their order."""
    ranges: list[SeedRange] = []
    for seed in sorted(set(seeds)):
        if ranges and seed == ranges[-1].last + 1:
            ranges[-1] = SeedRange(first=ranges[-1].first, last=seed)
        else:
            ranges.append(SeedRange(first=seed, last=seed))
    return tuple(ranges)


def generator(seed: int, stream: Stream, *extra: int) -> np.random.Generator:
    """Return a fresh generator (PCG64) for one purpose of one episode; `extra`: further numbers of it."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(stream, *extra))))


def seed_global_generators(*purpose: str | int) -> None:
    """Seed `random`, numpy's and, if it is imported, torch's generators by what they are about to be for.

    For policies that draw from generators that all code of a process shares; the harness never does. Without
    this, their draws would depend on the episodes that the process happened to run before.
    """
    digest = hashlib.sha256(repr(purpose).encode()).digest()
    random.seed(digest)  # noqa: TID251  # for the draws of others
    np.random.seed(np.frombuffer(digest, dtype="<u4"))  # noqa: TID251
    torch = sys.modules.get("torch")  # not imported for this: that takes seconds
    if torch is not None:
        torch.manual_seed(int.from_bytes(digest[:8], "little") >> 1)


@contextlib.contextmanager
def global_generators_kept() -> Iterator[None]:
    """Give these generators back as they were: in a process that is the user's own."""
    state, numpy_state = random.getstate(), np.random.get_state()  # nothing is drawn
    torch = sys.modules.get("torch")
    torch_state = torch.get_rng_state() if torch is not None else None
    try:
        yield
    finally:
        random.setstate(state)
        np.random.set_state(numpy_state)
        if torch is not None:
            torch.set_rng_state(torch_state)
