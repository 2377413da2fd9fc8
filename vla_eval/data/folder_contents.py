"""What may lie in a dataset's folder: regular files, none of them elsewhere. Does not read them."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path

from vla_eval.errors import DatasetError
from vla_eval.lock.switch import distrust

SNAPSHOTS, BLOBS = "snapshots", "blobs"
"""The Hub's cache keeps a dataset as `snapshots/REVISION`, whose files are links into its sibling `blobs`."""
REMEDY = "It is not read. Copy the dataset with `cp -rL` if you trust where it leads, or fetch it again."


def check_folder(root: Path) -> None:
    """Raise `DatasetError` unless all that lies below a folder is a regular file or a folder."""
    distrust(root)
    inside = root.resolve()
    blobs = inside.parent.parent / BLOBS if inside.parent.name == SNAPSHOTS else None
    for path in _entries(root):
        if path.is_symlink():
            target = _target(path)
            if not target.is_relative_to(inside) and (blobs is None or target.parent != blobs):
                raise DatasetError(
                    f"{path}: a link out of the dataset's folder, to {target!s:.300}. {REMEDY}"
                )
            path = target
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise DatasetError(f"{path}: expected a file or a folder, found a pipe or a device. {REMEDY}")


def _entries(root: Path) -> Iterator[Path]:
    """Yield all files, folders and links below a folder; links are not followed."""

    def refuse(exc: OSError) -> None:
        raise DatasetError(f"{root}: cannot be read ({exc}). Check who may read it.") from exc

    for folder, folders, files in os.walk(root, onerror=refuse):
        yield from (Path(folder, name) for name in (*folders, *files))


def _target(link: Path) -> Path:
    try:
        return link.resolve(strict=True)
    except (OSError, RuntimeError) as exc:  # nothing is there, or the link leads to itself
        raise DatasetError(f"{link}: a link that leads nowhere. {REMEDY}") from exc
