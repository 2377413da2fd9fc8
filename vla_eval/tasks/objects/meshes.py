"""A user's meshes as things of a task: those of a folder, read and checked. Knows nothing of simulators."""

import functools
from collections.abc import Mapping
from typing import NamedTuple

from vla_eval.errors import TaskArgumentError, some_of
from vla_eval.tasks.objects.mesh_checks import looks, solid_of
from vla_eval.tasks.objects.mesh_folder import MESHES, Asked, FolderFiles, Stamp, UnusableMeshError, asked
from vla_eval.tasks.objects.mesh_reading import read_surfaces
from vla_eval.tasks.objects.solids import Solid

MAX_SHOWN = 5  # meshes that one message names


class Mesh(NamedTuple):
    """One thing."""

    name: str  # of its file, or of its folder of YCB
    solid: Solid


class MeshSet(NamedTuple):
    """The meshes of a folder, by name: a task with N candidates has the first N."""

    asked: Asked  # the folder, with its digest
    meshes: tuple[Mesh, ...]
    sha256: Mapping[str, str]  # path in the folder -> digest, of each file that was read
    unread: tuple[str, ...]  # files beside them that no mesh uses

    @property
    def pinned(self) -> str:
        """The folder by its whole path, and the digest of its files, as a task argument."""
        return f"{FolderFiles(self.asked.folder).root}@{self.asked.digest}"

    @property
    def hashes(self) -> dict[str, str]:
        """The sha256 of each file, by its path under `meshes`, as a run records it."""
        return {f"{MESHES}/{file}": sha256 for file, sha256 in self.sha256.items()}

    @property
    def note(self) -> str:
        """What was read, and what was not, for people."""
        unread = f" Not read, since no mesh uses it: {some_of(self.unread)}." if self.unread else ""
        return (
            f"env.meshes: {len(self.meshes)} meshes of {self.asked}, of which a task has the first by name: "
            f"{some_of(mesh.name for mesh in self.meshes)}.{unread}"
        )

    def candidates(self, n_items: int) -> tuple[Mesh, ...]:
        """Return the first of them; a `TaskArgumentError` if there are too few."""
        if len(self.meshes) < n_items:
            more = f" (not read: {', '.join(self.unread[:6])})" if self.unread else ""
            raise TaskArgumentError(
                f"{MESHES}={self.asked.folder!r:.200}: expected at least {n_items} meshes, one for each "
                f"candidate, found {len(self.meshes)}{more}. Add some, or use a task with fewer candidates."
            )
        return self.meshes[:n_items]


def read_meshes(text: str, *, scale: float = 1.0, allow_holes: bool = False) -> MeshSet:
    """Return the meshes of a folder, checked.

    Args:
        text: `DIR`, or `DIR@DIGEST`.
        scale: factor of all sizes.
        allow_holes: whether surfaces need not be closed.

    Raises:
        TaskArgumentError: anything that could be wrong with the folder or a mesh; the message names the first
            meshes that are concerned.
    """
    wanted = asked(text)
    # Many callers ask for the same folder; what was found holds while no file in it has changed.
    found = _read(wanted.folder, scale, allow_holes, FolderFiles(wanted.folder).stamps())
    if wanted.digest not in (None, found.asked.digest):
        raise TaskArgumentError(
            f"{MESHES}: expected the files of {wanted}, found others in {wanted.folder!r:.200} "
            f"({found.asked}). Restore them, or name the folder without '@' and its digest, in a new run."
        )
    return found


@functools.lru_cache(maxsize=8)
def _read(folder: str, scale: float, allow_holes: bool, _stamps: tuple[Stamp, ...]) -> MeshSet:
    files = FolderFiles(folder)
    meshes: list[Mesh] = []
    wrong: list[str] = []
    alike: dict[bytes, str] = {}
    for name, file in files.meshes().items():
        try:
            solid = solid_of(read_surfaces(files, file, scale=scale), allow_holes=allow_holes)
            other = alike.setdefault(looks(solid), name)
            if other != name:
                raise UnusableMeshError(f"it is the same as {other!r}. Remove one of them")
        except UnusableMeshError as exc:
            wrong.append(f"{file}: {exc}.")
        else:
            meshes.append(Mesh(name, solid))
    if wrong:
        more = f" And {len(wrong) - MAX_SHOWN} more." if len(wrong) > MAX_SHOWN else ""
        raise TaskArgumentError(f"{MESHES}={files.shown}: {' '.join(wrong[:MAX_SHOWN])}{more}")
    return MeshSet(Asked(folder, files.digest), tuple(meshes), dict(files.sha256), files.unread)
