"""Seed the generators that all code of a process shares, for policies that draw from them.

The harness itself never does. Without this, what such a policy draws would depend on the episodes that its
process happened to run before.
"""

import hashlib
import random
import sys

import numpy as np


def seed_global_generators(*purpose: str | int) -> None:
    """Seed `random`, numpy's and, if it is imported, torch's generators by what they are about to be for."""
    digest = hashlib.sha256(repr(purpose).encode()).digest()
    random.seed(digest)  # noqa: TID251  # for the draws of others
    np.random.seed(np.frombuffer(digest, dtype="<u4"))  # noqa: TID251
    torch = sys.modules.get("torch")  # not imported for this: that takes seconds
    if torch is not None:
        torch.manual_seed(int.from_bytes(digest[:8], "little") >> 1)
