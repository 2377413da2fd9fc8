"""What each audit event is refused for. The events: docs.python.org/3/library/audit_events.html."""

import logging
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any  # the arguments of audit events are untyped

from vla_eval.errors import LockedError
from vla_eval.lock.state import STATE, may_run, may_write

HOW_TO_UNLOCK = "If you trust what is read, run the command with --no-lock (docs/security.md)."
TOOLS = (
    *("ldconfig", "ld", "objdump"),  # `ctypes.util.find_library`
    *("gcc", "g++", "cc", "c++", "clang", "clang++", "as", "ptxas", "nvcc"),  # `torch.compile`, triton
    *("uname", "lscpu", "nvidia-smi"),  # `platform`, torch: which machine this is
    "fc-list",  # matplotlib, when it is first used by someone: which fonts there are
    *("ffmpeg", "ffprobe"),
)
"""Programs that libraries start of their own accord: those of the system, or first on the search path."""
PROGRAM_FOLDERS = ("/bin", "/sbin", "/usr/bin", "/usr/sbin", "/usr/local/bin", "/usr/local/cuda/bin")
LOCAL_HOSTS = ("", "localhost", "127.0.0.1", "::1", "0.0.0.0", "::")
DEVICES = ("/dev/", "/proc/")  # `/dev/stderr` leads to wherever it was redirected
OF_MULTIPROCESSING = "pymp-"
"""Beginning of the folder with the sockets of Python's own processes."""
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

logger = logging.getLogger(__name__)


def audit(event: str, arguments: tuple[Any, ...]) -> None:
    """Refuse an event; for `sys.addaudithook`, which calls it for each event of this process."""
    check = _CHECKS.get(event)
    if check is not None and STATE.refuses:
        check(*arguments)


def refused(what: str) -> LockedError:
    """Log what was refused, and return the error: the code that asked may swallow it."""
    message = f"refused to {what}: what a checkpoint, a dataset or a server brings along may not."
    logger.warning("%s", message)
    return LockedError(f"{message} {HOW_TO_UNLOCK}")


def _start(program: Any, arguments: Any = (), *_: object) -> None:
    is_one = isinstance(arguments, str | bytes | os.PathLike)
    words = [os.fsdecode(word) for word in ([arguments] if is_one else arguments or ())]
    name = words[0] if program is None else os.fsdecode(program)
    found = shutil.which(name) or name
    is_of_system = os.path.basename(found) in TOOLS and os.path.dirname(found) in PROGRAM_FOLDERS
    if not (is_of_system or found in STATE.tools or _is_installed(found, words[1:])):
        raise refused(f"start the program {name!r:.200}")


def _is_installed(program: str, arguments: Sequence[str]) -> bool:
    """Whether it comes with a package that is installed, or is Python with a file of such a package."""
    if os.path.realpath(program) != os.path.realpath(sys.executable):
        return os.path.isabs(program) and may_run(program)
    script = next((word for word in arguments if not word.startswith("-")), "")
    return script != "" and not {"-c", "-m"} & set(arguments) and may_run(script)


def _shell(command: Any, *_: object) -> None:
    raise refused(f"run the command {command!r:.200}")


def _connect(_socket: Any, address: Any, *_: object) -> None:
    if address is None or STATE.network is not None:  # None: it is connected already
        return
    if isinstance(address, str | bytes):  # of a socket of this machine
        folder = os.path.dirname(os.path.realpath(os.fsdecode(address)))
        if os.path.basename(folder).startswith(OF_MULTIPROCESSING):
            return
    raise refused(f"connect to {address!r:.200}")


def _resolve(host: Any, *_: object) -> None:
    name = "" if host is None else os.fsdecode(host)
    if STATE.network is None and name not in LOCAL_HOSTS and name not in STATE.hosts:
        raise refused(f"look up the host {name!r:.200}")


def _open(path: Any, _mode: Any, flags: Any) -> None:
    if not isinstance(flags, int) or not flags & WRITING:
        return
    # A folder cannot be written; `tempfile` names it where it makes a file without a name, or with its own.
    if isinstance(path, int) or not os.path.isdir(path):
        _change(path)


def _write(path: Any, folder: Any = -1, *_: object) -> None:
    if isinstance(path, int):  # a file that is open already
        return
    place = _place(path, folder)
    if not may_write(place):
        raise refused(f"write to {place!r:.300}")


def _change(path: Any, folder: Any = -1, *_: object) -> None:
    """Refuse to change a file by a path: a link is followed, unlike where an entry is removed or renamed."""
    if isinstance(path, int):
        return
    place = _place(path, folder)
    _write(place if place.startswith(DEVICES) else os.path.realpath(place))


def _place(path: Any, folder: Any) -> str:
    """Return the resolved path of an entry: a link is what is written then, not what it leads to."""
    name = os.fsdecode(path)
    if isinstance(folder, int) and folder >= 0 and not os.path.isabs(name):
        name = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), name)
    parent, base = os.path.split(os.path.abspath(name))
    return os.path.join(os.path.realpath(parent), base)


def _make_folder(path: Any, _mode: Any, folder: Any = -1) -> None:
    place = _place(path, folder)
    is_above_a_named_one = any(named.startswith(f"{place}/") for named in STATE.writes)
    is_for_compiled_modules = os.path.basename(place) == "__pycache__" and may_run(place)
    if not (is_above_a_named_one or is_for_compiled_modules):
        _write(path, folder)


def _rename(old: Any, new: Any, old_folder: Any = -1, new_folder: Any = -1) -> None:
    _write(old, old_folder)
    _write(new, new_folder)


def _run_code(code: Any) -> None:
    name = getattr(code, "co_filename", "<string>")
    # In angle brackets: made in memory, as dataclasses, templates and torch's graphs are.
    if name and not name.startswith("<") and not may_run(name):
        raise refused(f"run the Python file {name!r:.300}, which is not installed")


_CHECKS: Mapping[str, Callable[..., None]] = {
    "subprocess.Popen": _start,
    "os.exec": _start,
    "os.posix_spawn": _start,
    "os.system": _shell,
    "pty.spawn": _shell,
    "socket.connect": _connect,
    "socket.sendto": _connect,
    "socket.sendmsg": _connect,
    "socket.getaddrinfo": _resolve,
    "socket.gethostbyname": _resolve,
    "socket.gethostbyaddr": _resolve,
    "open": _open,
    "os.remove": _write,
    "os.rmdir": _write,
    "os.truncate": _change,
    "os.mkdir": _make_folder,
    "os.chmod": lambda path, _mode, folder=-1: _change(path, folder),
    "os.chown": lambda path, _user, _group, folder=-1: _change(path, folder),
    "os.rename": _rename,
    "os.link": lambda _old, new, _old_folder=-1, new_folder=-1: _write(new, new_folder),
    "os.symlink": lambda _old, new, folder=-1: _write(new, folder),
    "exec": _run_code,
}
