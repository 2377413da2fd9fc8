"""The stored answers of an original code, and which of them a test has read."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from torch import Tensor


class GoldenValues(Mapping[str, Tensor]):
    """The tensors of a file; `unread` names those that nobody has asked for."""

    def __init__(self, path: Path) -> None:
        self._values = load_file(path)
        self._read: set[str] = set()

    def __getitem__(self, key: str) -> Tensor:
        self._read.add(key)
        return self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def unread(self) -> set[str]:
        return self._values.keys() - self._read


class GoldenFields(Mapping[str, Any]):
    """The fields of a description; `unread` names those that nobody has asked for, with dots."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self._data = {
            key: GoldenFields(value) if isinstance(value, dict) else value for key, value in data.items()
        }
        self._read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self._read.add(key)
        return self._data[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)

    def __len__(self) -> int:
        return len(self._data)

    def unread(self, prefix: str = "") -> set[str]:
        found = set()
        for key, value in self._data.items():
            if isinstance(value, GoldenFields):
                found |= value.unread(f"{prefix}{key}.")
            elif key not in self._read:
                found.add(f"{prefix}{key}")
        return found
