"""A safetensors file, one copied tensor at a time, so that a checkpoint is never in memory twice."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any  # safetensors is untyped

import torch
from safetensors import safe_open
from torch import Tensor

from vla_eval.errors import CheckpointError

DTYPES: Mapping[str, torch.dtype] = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}
"""Types of numbers by safetensors' names."""
ALIGNMENT = 8  # bytes; the header is filled up with spaces


class WeightFile(Mapping[str, Tensor]):
    """The tensors of a file by name, read at each access; its header is read and checked at once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with safe_open(path, framework="pt") as file:
                self._described = {name: _described(file.get_slice(name)) for name in list(file.keys())}
        except Exception as exc:  # safetensors raises a class of its own that is not public
            raise self._damaged(exc) from exc

    def described(self) -> Mapping[str, Tensor]:
        """Return the tensors without values, on torch's `meta` device: shape and type of each."""
        return self._described

    def __getitem__(self, name: str) -> Tensor:
        """Read one tensor; the result shares no memory with the file."""
        if name not in self._described:
            raise KeyError(name)
        try:
            with safe_open(self._path, framework="pt") as file:
                tensor: Tensor = file.get_tensor(name).clone()
        except Exception as exc:  # as above
            raise self._damaged(exc) from exc
        return tensor

    def __iter__(self) -> Iterator[str]:
        return iter(self._described)

    def __len__(self) -> int:
        return len(self._described)

    def _damaged(self, exc: Exception) -> CheckpointError:
        return CheckpointError(
            f"{self._path}: cannot be read as safetensors ({exc}). Fetch the checkpoint again."
        )


def describe(weights: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Return tensors of the same names, shapes and types; those of a file have no values."""
    return weights.described() if isinstance(weights, WeightFile) else weights


def _described(part: Any) -> Tensor:
    kind = part.get_dtype()
    if kind not in DTYPES:
        raise ValueError(f"numbers of type {kind}; known are {', '.join(DTYPES)}")
    return torch.empty(part.get_shape(), dtype=DTYPES[kind], device="meta")


def write_weights(
    path: Path, described: Mapping[str, Tensor], parts: Callable[[str], Iterable[Tensor]]
) -> None:
    """Write a safetensors file part by part, so that no tensor has to be in memory as a whole.

    `described`: name -> a tensor of that shape and type, whose values are not read. `parts`: name -> its
    numbers in order, in pieces of any size.

    Source of the format: https://github.com/huggingface/safetensors/blob/
    v0.8.0/README.md#format (length of the header, header as JSON, bytes of the tensors).
    """
    names = {dtype: name for name, dtype in DTYPES.items()}
    header: dict[str, object] = {"__metadata__": {"format": "pt"}}
    end = 0
    for name, tensor in described.items():
        begin, end = end, end + tensor.numel() * tensor.element_size()
        kind, shape = names[tensor.dtype], list(tensor.shape)
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [begin, end]}
    encoded = json.dumps(header, separators=(",", ":")).encode()
    encoded += b" " * (-len(encoded) % ALIGNMENT)
    with path.open("wb") as file:
        file.write(len(encoded).to_bytes(8, "little") + encoded)
        for name, tensor in described.items():
            n_left = tensor.numel()
            for part in parts(name):
                n_left -= part.numel() if part.dtype == tensor.dtype else tensor.numel() + 1
                if n_left >= 0:
                    file.write(part.contiguous().reshape(-1).view(torch.uint8).numpy().data)
            if n_left != 0:
                raise CheckpointError(
                    f"{path}: {name}: expected {tensor.numel():,} numbers of {tensor.dtype}, found others."
                )
