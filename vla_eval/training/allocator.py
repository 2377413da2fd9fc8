"""Keep freed memory in the process: what a training step frees, the next one needs again.

By default glibc takes each large tensor from the kernel and returns it, and the kernel fills every page with
zeros. A step of the positive control on ten episodes has 84,000 to 110,000 page faults; with this it has 0 to
25,000 (two cores, torch 2.13). The time they take depends on the kernel and was not measured separately.

What is kept is used again only by blocks that fit into it. A network whose large tensors have another size in
each step computes them in parts of one size, as the encoders of `models/sequence` do, or the process grows.
"""

import ctypes
import sys

# glibc's malloc.h
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
NEVER_BYTES = (1 << 31) - 1


def keep_freed_memory() -> bool:
    """Let malloc keep large blocks and free memory in the process; return whether it does.

    Without glibc (macOS, musl) nothing is changed. No result depends on it.
    """
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):
        return False
    return bool(libc.mallopt(M_MMAP_MAX, 0)) and bool(libc.mallopt(M_TRIM_THRESHOLD, NEVER_BYTES))
