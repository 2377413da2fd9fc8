"""Write a folder next to its place and rename it when it is whole. Knows nothing of what it holds."""

import contextlib
import errno
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vla_eval.errors import VlaEvalError
from vla_eval.lock.switch import let_write
from vla_eval.storage.durable import on_disk, sync_path, sync_tree

DRAFT_SUFFIX = ".draft"
NO_LINKS = frozenset({errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP, errno.ENOSYS})


@contextlib.contextmanager
def whole_folder(out: Path, *, error: type[VlaEvalError]) -> Iterator[Path]:
    """Give a place to write to that becomes `out`, or is removed after an exception; `error` if it exists."""
    if out.exists():
        raise error(f"{out}: exists already. Name a new folder with --out, or remove this one.")
    let_write(out)
    remove_drafts(out)
    draft = draft_path(out)
    draft.parent.mkdir(parents=True, exist_ok=True)
    try:
        with on_disk(out):
            yield draft
            publish(draft, out)
    except BaseException:
        remove_drafts(out)
        raise


def draft_path(path: Path) -> Path:
    """Return a draft's path, new for each process: lerobot keeps decoders open by their path."""
    return path.with_name(f"{path.name}.{os.getpid()}{DRAFT_SUFFIX}")


def remove_drafts(path: Path) -> None:
    """Remove what earlier processes began to write."""
    for draft in path.parent.glob(f"{glob.escape(path.name)}.*{DRAFT_SUFFIX}"):
        shutil.rmtree(draft, ignore_errors=True)


def publish(draft: Path, path: Path) -> None:
    """Make a folder durable and give it its final name, in one step that cannot be cut in half."""
    sync_tree(draft)
    os.rename(draft, path)
    sync_path(path.parent)


@contextlib.contextmanager
def appearing(folder: Path) -> Iterator[Path]:
    """Give an empty draft that gets the folder's name when it is filled; one that is there by then stays."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    place = tempfile.TemporaryDirectory(
        prefix=f".{folder.name}-", dir=folder.parent, ignore_cleanup_errors=True
    )
    with place:
        draft = Path(place.name, folder.name)
        draft.mkdir()
        try:
            yield draft
            draft.rename(folder)
        except OSError:
            if not folder.is_dir():  # otherwise another process was faster
                raise


def link_file(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the file system cannot link."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError as exc:
        if exc.errno not in NO_LINKS:
            raise
        shutil.copyfile(source, target)


def link_tree(source: Path, target: Path) -> None:
    """Do the same with all files below a folder."""
    for folder, _, names in os.walk(source):
        for name in names:
            file = Path(folder) / name
            link_file(file, target / file.relative_to(source))
