"""The memory of this process and of its machine, as Linux states it. Knows nothing of policies."""

import contextlib
import gc
import resource
from pathlib import Path

import torch

CLEAR_REFS, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


def reset_peak() -> None:
    """Let the peak of this process's memory begin from now, where the kernel can do that."""
    with contextlib.suppress(OSError):  # the peak is then that since the start: higher, never lower
        CLEAR_REFS.write_text("5")


def peak_rss_bytes() -> int:
    """Return the most memory that this process has had since `reset_peak`."""
    if STATUS.is_file():
        for line in STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def free_unused() -> None:
    """Free what is not used, on the GPU, too."""
    gc.collect()  # a policy and its processors refer to each other
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def reset_device_peak(device: str) -> None:
    """Free what is not used, and start the peak from what is left, not from a model measured before."""
    if torch.device(device).type == "cuda":
        free_unused()
        torch.cuda.reset_peak_memory_stats(device)


def peak_device_bytes(device: str) -> int | None:
    """Return the most memory of tensors since `reset_device_peak`; None on a CPU."""
    return torch.cuda.max_memory_allocated(device) if torch.device(device).type == "cuda" else None
