"""The memory of a GPU that this process takes, as torch counts it."""

import gc

import torch


def reset_device_peak(device: str) -> None:
    """Free what is not used, and let the peak begin from scratch; a model measured before would be in it."""
    if torch.device(device).type == "cuda":
        gc.collect()  # a policy and its processors refer to each other
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def peak_device_bytes(device: str) -> int | None:
    """Return the most memory of tensors since `reset_device_peak`; None on a CPU."""
    return torch.cuda.max_memory_allocated(device) if torch.device(device).type == "cuda" else None
