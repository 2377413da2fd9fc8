"""Small folders that are sent to a machine that does not have them. Knows nothing of their content."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from vla_eval.storage.drafts import appearing

MAX_PARCEL_BYTES = 64_000_000
"""Of all folders of one checkpoint; the driver reads them into memory. Others need shared storage."""


class PackedFolder(NamedTuple):
    """A folder, its path absolute or below the working directory, and the content of each file by name."""

    path: str
    files: dict[str, bytes]

    @property
    def n_bytes(self) -> int:
        """How much its files hold."""
        return sum(map(len, self.files.values()))


def fits(folders: Iterable[Path]) -> bool:
    """Whether the folders together are small enough to be sent."""
    return sum(file.stat().st_size for folder in folders for file in _files(folder)) <= MAX_PARCEL_BYTES


def pack(path: str) -> PackedFolder:
    """Read a folder."""
    folder = Path(path)
    files = {file.relative_to(folder).as_posix(): file.read_bytes() for file in _files(folder)}
    return PackedFolder(path, files)


def unpack(packed: PackedFolder) -> None:
    """Write a folder; it appears whole or not at all. What is there already stays."""
    with appearing(Path(packed.path)) as draft:
        for name, content in packed.files.items():
            file = draft / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)


def _files(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.rglob("*")) if file.is_file()]
