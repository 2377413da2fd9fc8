"""Make modules in another precision from the beginning: a big one in float32 would not fit into memory."""

import contextlib
from collections.abc import Iterator

import torch

DTYPES = ("float32", "bfloat16")
"""Names of precisions that a recipe may choose."""


@contextlib.contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """Let what is made inside have this type of numbers."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
