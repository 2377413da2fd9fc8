"""Which numbers are computed in which precision. Knows only torch.

Under autocast all that a policy computes is in bfloat16, its images included, though its network alone is
meant. So what prepares or reads out numbers (images, geometry, normalisation, heads) is marked `in_float32`.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

DTYPES = ("float32", "bfloat16")
"""Names of precisions that a recipe may choose."""
AUTOCAST_DEVICES = ("cpu", "cuda", "mps")
_HALF = (torch.bfloat16, torch.float16)


@contextlib.contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """Let what is made inside have this type of numbers."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def in_float32[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Compute a function or method without autocast; tensors of half precision reach it as float32."""

    @functools.wraps(function)
    def exact(*args: P.args, **kwargs: P.kwargs) -> R:
        with contextlib.ExitStack() as stack:
            for device in AUTOCAST_DEVICES:
                if torch.is_autocast_enabled(device):
                    stack.enter_context(torch.autocast(device, enabled=False))
            return function(*_as_float32(args), **_as_float32(kwargs))

    return exact


def _as_float32(value: Any) -> Any:  # Any: whatever a function is given
    """Return the value with all tensors of half precision in it as float32."""
    if isinstance(value, Tensor):
        return value.float() if value.dtype in _HALF else value
    if isinstance(value, tuple):
        parts = [_as_float32(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, list):
        return [_as_float32(part) for part in value]
    if isinstance(value, Mapping):
        return {key: _as_float32(part) for key, part in value.items()}
    return value
