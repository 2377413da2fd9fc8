"""Names of devices, for networks and for renderers; known without torch and a simulator."""

import re
from collections.abc import Mapping

from vla_eval.errors import MissingDependencyError, RecipeError

_NETWORK = re.compile(r"auto|cpu|mps|cuda(:\d+)?")
_RENDERER = re.compile(r"auto|cpu|gpu|sapien_cpu|(sapien_)?cuda(:\d+)?|pci:\S+")
_GPU = re.compile(r"gpu|(?:sapien_)?cuda(?::(\d+))?")


def check_device(device: str, *, name: str = "device", renders: bool = False) -> str:
    """Return the name of a device for a network, or of one that `renders`; refuse another name."""
    if not (_RENDERER if renders else _NETWORK).fullmatch(device):
        known = (
            "auto, cpu, gpu, or a device as SAPIEN names it: cuda:1" if renders else "auto, cpu, cuda, cuda:1"
        )
        raise RecipeError(f"{name} is '{device:.80}', expected {known}.")
    return device


def refuse_missing_gpu(n_gpus: int, asked: Mapping[str, str]) -> None:
    """Raise `MissingDependencyError` if a device is a GPU beyond this many; `asked`: what asks -> device."""
    for name, device in asked.items():
        found = _GPU.fullmatch(device)
        if found and int(found[1] or 0) >= n_gpus:
            raise MissingDependencyError(
                f"{name} is '{device}', but there are {n_gpus or 'no'} GPUs here. Use cpu, or run "
                "`mikasa-vla doctor`, which says what is missing."
            )
