"""Where a LeRobot policy computes, and in which precision."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any  # lerobot is untyped

import torch

from vla_eval.strict.devices import check_device, refuse_missing_gpu


def choose_device(device: str) -> str:
    """Return the device that `auto` means here; refuse one that is not there."""
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    refuse_missing_gpu(torch.cuda.device_count(), {"device": check_device(device)})
    return device


def cuda_devices(device: str) -> list[torch.device]:
    """Return the GPUs of which a policy on this device may draw random numbers."""
    return [torch.device(device)] if str(device).startswith("cuda") else []


def amp_dtype(device: str) -> torch.dtype:
    """Return the half precision of `use_amp`: bfloat16, whose range is float32's, or else float16."""
    kind = torch.device(device).type
    if kind == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False):
        return torch.bfloat16
    return torch.get_autocast_dtype(kind)


def autocast(config: Any) -> AbstractContextManager[None]:
    """Return the context in which a policy of this configuration computes."""
    if not config.use_amp:
        return nullcontext()
    device = str(config.device)
    return torch.autocast(torch.device(device).type, amp_dtype(device))
