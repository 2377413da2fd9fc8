"""Random generators that depend on an episode's seed and a purpose, and on nothing else.

One generator per (episode seed, purpose): what one purpose draws cannot shift what another one gets,
and neither batch size, device, order of episodes nor global random state plays a part.
"""

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


def generator(seed: int, stream: Stream, *extra: int) -> np.random.Generator:
    """Return a fresh generator for one purpose of one episode.

    Args:
        seed: the episode's seed, ≥ 0.
        stream: the purpose.
        extra: further numbers that tell draws of one purpose apart, such as the run index.

    Returns:
        A PCG64 generator; the same arguments always give the same draws.
    """
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(stream, *extra))))
