"""The files of a folder of meshes: which mesh each is of, what it holds, and nothing outside of the folder.

A task is given it as `DIR`, or as `DIR@DIGEST`, which holds only while its files are the same. Knows nothing
of what is in a file.
"""

import hashlib
import itertools
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple  # Any: the user's task arguments

from vla_eval.errors import TaskArgumentError, some_of

MESHES = "meshes"
"""The task argument that names the folder."""
FORMATS = (".glb", ".gltf", ".obj", ".stl")
MODELS, MODEL_FILE = "models", "textured.obj"  # as ManiSkill's download of YCB has them, a folder per object
MAX_FILE_BYTES = 64 * 2**20
MAX_MESHES, MAX_FILES = 500, 20_000
N_DIGITS = 16  # of the digest of a folder
_PINNED = re.compile(rf"(?P<folder>.+)@(?P<digest>[0-9a-f]{{{N_DIGITS}}})", re.DOTALL)
_NAME = re.compile(r"\w[\w .-]{0,63}")  # of a mesh: it is read in tables, records and file names


class UnusableMeshError(TaskArgumentError):
    """Why one mesh cannot be used, and what to do; without a full stop."""


class Stamp(NamedTuple):
    """A file, and when it was changed."""

    path: str
    changed_ns: int
    n_bytes: int


class Asked(NamedTuple):
    """What `DIR` or `DIR@DIGEST` says."""

    folder: str
    digest: str | None

    def __str__(self) -> str:
        """Return the text without the folder's path: what may be published."""
        name = Path(self.folder).name
        return name if self.digest is None else f"{name}@{self.digest}"


def asked(text: str) -> Asked:
    """Read the value of the task argument."""
    match = _PINNED.fullmatch(text)
    return Asked(text, None) if match is None else Asked(match["folder"], match["digest"])


def without_path(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return task arguments as they may be published: of a folder of meshes its name and digest."""
    text = arguments.get(MESHES)
    return {**arguments, MESHES: str(asked(text))} if isinstance(text, str) else dict(arguments)


class FolderFiles:
    """Reads files of a folder, each once, and remembers the sha256 of each by its path in the folder."""

    def __init__(self, text: str) -> None:
        self.shown = f"{text!r:.200}"
        try:
            self.root = Path(text).expanduser().resolve()
            found = "" if text and os.access(self.root, os.R_OK | os.X_OK) else "nothing that can be read"
            found = found or ("" if self.root.is_dir() else "a file")
        except (OSError, RuntimeError, ValueError) as exc:  # a long name, no such user's folder, a zero byte
            found = f"what is no path ({getattr(exc, 'strerror', None) or exc})"
        if found:
            raise TaskArgumentError(
                f"{MESHES}={self.shown}: expected a folder of meshes ({', '.join(FORMATS)}), found {found}. "
                "Run the command where the folder lies, or name it with its whole path."
            )
        self.sha256: dict[str, str] = {}

    def meshes(self) -> dict[str, PurePosixPath]:
        """Return name -> file of each mesh, by name.

        Raises:
            TaskArgumentError: there is none, or two have one name, or one that cannot be an item's.
        """
        found: dict[str, list[PurePosixPath]] = {}
        for entry in sorted(self.root.iterdir()):
            if entry.suffix.lower() in FORMATS and not entry.name.startswith("."):
                found.setdefault(entry.stem, []).append(PurePosixPath(entry.name))
        models = self.root / MODELS
        for entry in sorted(models.iterdir()) if models.is_dir() else ():
            if entry.is_dir() and not entry.name.startswith("."):
                found.setdefault(entry.name, []).append(PurePosixPath(MODELS, entry.name, MODEL_FILE))
        for problem in (
            f"no mesh in it ({', '.join(FORMATS)}); it has {self._entries()}" if not found else "",
            f"more than {MAX_MESHES} meshes" if len(found) > MAX_MESHES else "",
            *(f"several meshes of the name {name!r}" for name, files in found.items() if len(files) > 1),
            *(f"the name {name!r:.80}" for name in found if not _NAME.fullmatch(name)),
        ):
            if problem:
                raise TaskArgumentError(
                    f"{MESHES}={self.shown}: found {problem}. Expected one file for each mesh, with a name "
                    "of up to 64 letters, digits, spaces, '.', '_' and '-'. Change the folder."
                )
        return {name: files[0] for name, files in sorted(found.items())}

    def stamps(self) -> tuple[Stamp, ...]:
        """Return what changes when a file of the folder does."""
        entries = list(itertools.islice(self.root.rglob("*"), MAX_FILES + 1))
        if len(entries) > MAX_FILES:
            raise TaskArgumentError(
                f"{MESHES}={self.shown}: expected a folder of meshes alone, found more than {MAX_FILES} "
                "files. Copy the meshes into a folder of their own."
            )
        stats = ((entry, entry.lstat()) for entry in entries)
        return tuple(sorted(Stamp(str(entry), one.st_mtime_ns, one.st_size) for entry, one in stats))

    def _entries(self) -> str:
        return some_of(entry.name for entry in sorted(self.root.iterdir())) or "no files"

    @property
    def unread(self) -> tuple[str, ...]:
        """Files beside the meshes that no mesh has asked for."""
        files = (entry.name for entry in sorted(self.root.iterdir()) if not entry.is_dir())
        return tuple(name for name in files if name not in self.sha256)

    @property
    def digest(self) -> str:
        """Digest of what was read: names and contents, in the order of names."""
        lines = "".join(f"{sha256}  {name}\n" for name, sha256 in sorted(self.sha256.items()))
        return hashlib.sha256(lines.encode()).hexdigest()[:N_DIGITS]

    def content(self, file: PurePosixPath) -> bytes:
        """Return the content of a file of the folder.

        Raises:
            UnusableMeshError: its path, or a link on it, leads out of the folder; there is no such file; or
                it is no plain file or too large.
        """
        path = (self.root / file).resolve()
        if file.is_absolute() or ".." in file.parts or not path.is_relative_to(self.root):
            raise UnusableMeshError(f"{str(file)!r:.120} is outside of the folder. Copy it into the folder")
        try:
            about = path.stat()
            if not stat.S_ISREG(about.st_mode):
                raise UnusableMeshError(f"{str(file)!r:.120} is no plain file. Replace it")
            if about.st_size > MAX_FILE_BYTES:
                limit = MAX_FILE_BYTES // 2**20
                raise UnusableMeshError(
                    f"{str(file)!r:.120} has {about.st_size / 2**20:.0f} MiB, expected at most {limit}. "
                    "Simplify it"
                )
            content = path.read_bytes()
        except (OSError, ValueError) as exc:  # ValueError: a zero byte in the name
            reason = getattr(exc, "strerror", None) or exc
            raise UnusableMeshError(f"{str(file)!r:.120} cannot be read ({reason}). Put it there") from exc
        self.sha256[str(file)] = hashlib.sha256(content).hexdigest()
        return content
