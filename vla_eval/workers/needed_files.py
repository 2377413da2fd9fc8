"""A file or folder that every machine must have, and how it is recognised. Knows nothing of its content."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vla_eval.errors import VlaEvalError


@dataclass(frozen=True, slots=True, kw_only=True)
class Needed:
    """A path, as the planning machine has it."""

    path: str  # absolute, or below the working directory
    sha256: str | None = None  # its digest; None: it is enough that it is there
    digest: Callable[[Path], str] | None = None  # what computes the digest
    # those that it consists of, if they are small enough to be sent to a machine that does not have them
    # (`parcel.MAX_PARCEL_BYTES`); empty: it must be there
    folders: tuple[str, ...] = ()

    def absent(self) -> tuple[str, ...]:
        """Return which of its folders can be sent and are not on this machine."""
        return tuple(folder for folder in self.folders if not Path(folder).exists())

    def objection(self) -> str | None:
        """Return what is wrong with it on this machine; None: nothing."""
        if self.digest is None:
            there = Path(self.path).exists()
            return None if there else f"{self.path}: it is not there; is the storage shared?"
        try:
            found = self.digest(Path(self.path))
        except (OSError, VlaEvalError) as exc:
            return f"{self.path}: cannot be read ({exc})"
        if found != self.sha256:
            return f"{self.path}: another one (sha256 {found:.12}…, expected {self.sha256:.12}…)"
        return None


def shared_folder(path: Path) -> Needed:
    """Return a folder that workers write into or read from, or the one that it will be made in."""
    folder = path.resolve()
    while not folder.exists():
        folder = folder.parent
    return Needed(path=str(folder))
