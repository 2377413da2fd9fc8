"""Write files so that a killed process, a full disk or a power cut loses nothing that was promised.

Ours, since a record has to be a line of plain text that is durable when `append` returns, and gone if the
disk was full: Python's files promise neither, and a database is not text. Knows nothing of episodes.
"""

import contextlib
import errno
import fcntl
import logging
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from vla_eval.errors import FolderInUseError, LockedError, RunFolderError, StorageFullError
from vla_eval.strict.json_text import Source, read_file

logger = logging.getLogger(__name__)

DISK_TROUBLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


def sync_path(path: Path) -> None:
    """Make a file durable, or the names of a folder's files: else a new one may be gone after a power cut."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def replace_file(path: Path, text: str) -> None:
    """Write a file so that at any moment either the old content or the new one is there, never a part.

    `<name>.tmp` is used on the way. `StorageFullError`: the old content is still there.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    data = text.encode("utf-8", errors="backslashreplace")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_path(path.parent)
    except OSError as exc:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise storage_full(path, exc) from exc


def sync_tree(folder: Path) -> None:
    """Make all files below a folder durable, and their names."""
    for place, _, names in os.walk(folder):
        for path in (*(Path(place, name) for name in names), Path(place)):
            sync_path(path)


def read_lines(path: Path) -> bytes:
    """Return the bytes of a file of lines, none if it is not there."""
    source = Source(where=str(path), what="a file of JSON lines", remedy="", error=RunFolderError)
    try:
        return read_file(path, source)
    except (FileNotFoundError, NotADirectoryError):
        return b""


def whole_lines(data: bytes, path: Path) -> Iterator[tuple[bytes, str]]:
    """Yield each line, and `FILE:NUMBER` for messages. What follows the last newline was being written."""
    for number, line in enumerate(data.split(b"\n")[:-1], start=1):
        yield line, f"{path}:{number}"


def cut_tail(path: Path) -> None:
    """Cut off an incomplete last line of a file that no result depends on."""
    data = read_lines(path)
    end = data.rfind(b"\n") + 1
    if end != len(data):
        os.truncate(path, end)


class LineFile:
    """A file that lines are appended to, each of them whole or not at all.

    It is made if it is not there, and must be empty or end with a newline. `durable`: a line is on the disk,
    and not just on its way, when `append` returns.
    """

    def __init__(self, path: Path, *, durable: bool) -> None:
        self._path = path
        self._durable = durable
        self._is_broken = False
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)

    def append(self, line: str) -> None:
        """Append one line, given without its end; `StorageFullError`: the file is as it was before."""
        self.append_all([line])

    def append_all(self, lines: Sequence[str]) -> None:
        """Append several lines at once: all of them or, if that fails, none. See `append`."""
        if not lines:
            return
        if self._is_broken:
            raise RunFolderError(
                f"{self._path}: an earlier line could neither be written nor taken back. Run the same "
                f"command again: it repairs the end of the file."
            )
        # A lone surrogate (a file name in a traceback, say) has no UTF-8; `\udc80` is the same in JSON.
        data = "".join(f"{line}\n" for line in lines).encode("utf-8", errors="backslashreplace")
        size_before = os.fstat(self._fd).st_size
        try:
            # One write, so that a killed process leaves at most one incomplete line, and at the end.
            n_written = os.write(self._fd, data)
            if n_written != len(data):
                raise OSError(errno.ENOSPC, f"only {n_written} of {len(data)} bytes could be written")
            if self._durable:
                os.fsync(self._fd)
        except BaseException as exc:  # an interrupt too must leave no line that nobody knows of
            self._cut_back(size_before)
            if isinstance(exc, OSError):
                raise storage_full(self._path, exc) from exc
            raise

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _cut_back(self, size: int) -> None:
        try:
            os.ftruncate(self._fd, size)
            os.fsync(self._fd)
        except OSError as exc:
            self._is_broken = True
            logger.warning("%s: the incomplete last line could not be cut off (%s)", self._path, exc)


class FolderLock:
    """Keeps a second process out of a folder, for as long as this process lives.

    The lock belongs to the open file, so the kernel drops it when the process dies, however it dies;
    the file itself stays, with the process id in it, and means nothing.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as exc:
            holder = os.pread(self._fd, 32, 0).decode(errors="replace").strip() or "unknown"
            os.close(self._fd)
            raise FolderInUseError(
                f"{path.parent}: another process (pid {holder}) is writing into this run folder. Wait for "
                f"it, stop it, or use another --out."
            ) from exc
        except OSError as exc:
            os.close(self._fd)
            raise RunFolderError(
                f"{path.parent}: the file system cannot lock files ({exc.strerror}), so two processes could "
                f"write at once. Use a --out on a local disk."
            ) from exc
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Let others in; a second call does nothing."""
        if self._fd >= 0:
            # Not just closed: a forked child that still has the descriptor would keep the lock.
            fcntl.flock(self._fd, fcntl.LOCK_UN)
            os.close(self._fd)
            self._fd = -1


@contextlib.contextmanager
def on_disk(path: Path) -> Iterator[None]:
    """Raise `StorageFullError` if what is written below a path meets a full or a broken disk."""
    try:
        yield
    except Exception as exc:  # that of safetensors only names the number
        named = re.search(r"\(os error (\d+)\)", str(exc))
        number = int(named[1]) if named else getattr(exc, "errno", None)
        if number not in DISK_TROUBLE:
            raise
        raise storage_full(path, OSError(number, os.strerror(number))) from exc


def storage_full(path: Path, cause: OSError) -> StorageFullError:
    """Build the error for a file that could not be written, or only in part."""
    if isinstance(cause, LockedError):
        return StorageFullError(f"{path}: could not be written. Name its folder in the command, or: {cause}")
    is_closed = cause.errno in (errno.EACCES, errno.EPERM, errno.EROFS)
    return StorageFullError(
        f"{path}: could not be written ({cause.strerror or cause}). Nothing that was reported as finished is "
        f"lost. {'Make it writable' if is_closed else 'Free some space'} and run the same command again."
    )
