"""The lock alone: code that already runs starts, asks, writes and imports nothing; what we need goes on."""

import importlib
import importlib.util
import os
import pickle
import platform
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jinja2
import pytest

from vla_eval.errors import LockedError, VlaEvalError
from vla_eval.lock.events import _CHECKS
from vla_eval.lock.state import STATE, State
from vla_eval.lock.switch import (
    OFF_VARIABLE,
    distrust,
    folders_for_workers,
    let_connect,
    let_everything,
    let_write,
    locked,
    own_need,
)

PAYLOAD = "import pathlib; pathlib.Path({mark!r}).write_text('ran')"


@pytest.fixture
def mark(tmp_path: Path) -> Iterator[Path]:
    """What must not be there afterwards."""
    yield tmp_path / "mark"
    assert not (tmp_path / "mark").exists()


def _by_pickle(function: Callable[..., object], *arguments: object) -> Callable[[], object]:
    class Payload:
        def __reduce__(self) -> tuple[Any, ...]:
            return function, arguments

    data = pickle.dumps(Payload())
    return lambda: pickle.loads(data)


def _in_thread(work: Callable[[], object]) -> Callable[[], object]:
    """Do it in another thread, and raise here what it raised there."""

    def run() -> None:
        raised: list[BaseException] = []

        def attempt() -> None:
            try:
                work()
            except BaseException as exc:
                raised.append(exc)

        thread = threading.Timer(0.01, attempt)
        thread.start()
        thread.join()
        raise raised[0]

    return run


def programs(mark: Path) -> dict[str, Callable[[], object]]:
    """Return ways to start a program that makes `mark`."""
    touch = ["touch", str(mark)]
    line = " ".join(touch)
    code = PAYLOAD.format(mark=str(mark))
    template = "{{ cycler.__init__.__globals__.os.system(line) }}"
    return {
        "os.system": lambda: os.system(line),
        "os.popen": lambda: os.popen(line).read(),
        "subprocess": lambda: subprocess.run(touch),
        "a shell": lambda: subprocess.run(line, shell=True),
        "an absolute path": lambda: subprocess.run([shutil.which("touch") or "", str(mark)]),
        "a path beside": lambda: subprocess.run(["./touch", str(mark)]),
        "bytes": lambda: subprocess.run([b"touch", os.fsencode(mark)]),
        "this Python with code": lambda: subprocess.run([sys.executable, "-c", code]),
        "this Python with a module": lambda: subprocess.run([sys.executable, "-m", "timeit"]),
        "a tool's name elsewhere": lambda: subprocess.run([str(_copied_tool(mark))]),
        "env": lambda: subprocess.run(["env", *touch]),
        "posix_spawn": lambda: os.posix_spawn("/usr/bin/touch", touch, {}),
        "execv": lambda: os.execv("/usr/bin/touch", touch),
        "spawnv": lambda: _failed(os.spawnv(os.P_WAIT, "/usr/bin/touch", touch)),
        "a template": lambda: jinja2.Template(template).render(line=line),
        "a pickle": _by_pickle(os.system, line),
        "a pickle of subprocess": _by_pickle(subprocess.check_output, touch),
        "another thread, later": _in_thread(lambda: os.system(line)),
    }


def _failed(code: int) -> None:
    """Raise what the child of a fork could not: it ends with 127 where its program does not start."""
    assert code == 127
    raise LockedError("refused to start it in a child --no-lock")


def _copied_tool(mark: Path) -> Path:
    place = mark.parent / "gcc"
    with own_need():
        place.write_text(f"#!/bin/sh\ntouch {mark}\n")
        place.chmod(0o755)
    return place


@pytest.mark.parametrize("name", programs(Path()))
def test_no_program_is_started(mark: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    with locked(), pytest.raises(LockedError, match=r"refused to (start|run).*--no-lock"):
        programs(mark)[name]()
    assert name == "spawnv" or "refused to" in caplog.text  # said even where the error is swallowed


def _link(owned: Path, target: Path) -> Path:
    """Return a link in the folder that may be written, which leads out of it."""
    link = owned.with_name("link")
    link.symlink_to(target)
    return link


def writes(mark: Path, owned: Path) -> dict[str, Callable[[], object]]:
    """Return ways to make or change something at `mark`; `owned` is a file that may be written."""
    folder = os.open(mark.parent, os.O_RDONLY)
    template = "{{ cycler.__init__.__globals__.os.mkdir(p) }}"
    return {
        "open": lambda: open(mark, "w"),
        "through a link": lambda: open(_link(owned, mark), "w"),
        "truncate through a link": lambda: os.truncate(_link(owned, mark.parent / "kept"), 0),
        "append": lambda: open(mark, "a"),
        "os.open": lambda: os.open(mark, os.O_CREAT | os.O_WRONLY),
        "by a folder's descriptor": lambda: os.open("mark", os.O_CREAT | os.O_WRONLY, dir_fd=folder),
        "bytes": lambda: open(os.fsencode(mark), "wb"),
        "mkdir": lambda: mark.mkdir(),
        "makedirs": lambda: os.makedirs(mark / "a" / "b"),
        "link": lambda: os.link(owned, mark),
        "symlink": lambda: os.symlink(owned, mark),
        "rename": lambda: os.rename(owned, mark),
        "replace": lambda: os.replace(owned, mark),
        "move": lambda: shutil.move(owned, mark),
        "copy": lambda: shutil.copy(owned, mark),
        "up and down": lambda: open(owned.parent / ".." / "mark", "w"),
        "by a template": lambda: jinja2.Template(template).render(p=str(mark)),
        "a pickle": _by_pickle(os.mkdir, str(mark)),
        "another thread": _in_thread(lambda: open(mark, "w")),
        "remove something else": lambda: os.remove(mark.parent / "kept"),
        "remove by descriptor": lambda: os.remove("kept", dir_fd=folder),
        "overwrite something else": lambda: open(mark.parent / "kept", "r+"),
        "truncate": lambda: os.truncate(mark.parent / "kept", 0),
        "chmod": lambda: os.chmod(mark.parent / "kept", 0),
    }


@pytest.mark.parametrize("name", writes(Path(), Path()))
def test_nothing_outside_the_named_folders_is_written(tmp_path: Path, mark: Path, name: str) -> None:
    (tmp_path / "kept").write_text("kept")
    out = tmp_path / "out"
    out.mkdir()
    (out / "file").write_text("ours")
    with locked():
        let_write(out)
        with pytest.raises(LockedError, match="refused to write to"):
            writes(mark, out / "file")[name]()
    assert (tmp_path / "kept").read_text() == "kept" and (out / "file").exists()


def test_what_the_user_named_is_written(tmp_path: Path) -> None:
    with locked():
        let_write(tmp_path / "a" / "out")
        (tmp_path / "a" / "out" / "deep").mkdir(parents=True)
        (tmp_path / "a" / "out" / "deep" / "file").write_text("1")
        (tmp_path / "a" / "out.12.tmp").mkdir()  # a draft, which is then renamed
        (tmp_path / "a" / "out.12.tmp").rename(tmp_path / "a" / "out" / "new")
        shutil.rmtree(tmp_path / "a" / "out")
        with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "x", "w") as file:
            file.write("1")
        with tempfile.TemporaryFile() as unnamed, tempfile.NamedTemporaryFile() as named:
            unnamed.write(b"1")
            named.write(b"1")
        with open(os.devnull, "w") as file:
            file.write("1")


def test_workers_may_write_where_their_parent_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with locked():
        let_write(tmp_path / "out")
        folders = folders_for_workers()
    assert str(tmp_path / "out") in folders.split(os.pathsep)
    monkeypatch.setenv("MIKASA_VLA_WRITES", folders)
    with locked():
        (tmp_path / "out").mkdir()


def connections(port: int) -> dict[str, Callable[[], object]]:
    """Return ways to reach a server on this machine, or to tell one elsewhere."""
    url = f"http://127.0.0.1:{port}"
    import urllib.request

    def connect() -> None:
        with socket.socket() as one:
            one.connect(("127.0.0.1", port))

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.sendto(b"secret", ("127.0.0.1", port))

    def local() -> None:
        with socket.socket(socket.AF_UNIX) as one:
            one.connect("/run/docker.sock")

    return {
        "connect": connect,
        "create_connection": lambda: socket.create_connection(("127.0.0.1", port)),
        "udp": send,
        "a socket of a service": local,
        "urllib": lambda: urllib.request.urlopen(url),
        "a look-up": lambda: socket.getaddrinfo("secret.example.org", 80),
        "an old look-up": lambda: socket.gethostbyname("secret.example.org"),
        "another thread": _in_thread(connect),
    }


@pytest.mark.parametrize("name", connections(0))
def test_nothing_is_connected(name: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, locked():
        server.settimeout(0.05)
        with pytest.raises((LockedError, OSError)) as caught:
            connections(server.getsockname()[1])[name]()
        assert "refused to" in f"{caught.value} {caught.value.__cause__}"
        with pytest.raises(TimeoutError):
            server.accept()


def test_a_connection_that_the_user_asked_for_is_made() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, locked():
        with own_need():
            socket.create_connection(server.getsockname()).close()
        let_connect("a logger")
        socket.create_connection(server.getsockname()).close()


def modules(folder: Path, mark: Path) -> dict[str, Callable[[], object]]:
    """Return ways to run the Python file `folder/evil.py`."""
    with own_need():
        folder.mkdir()
        (folder / "evil.py").write_text(PAYLOAD.format(mark=str(mark)))
        (folder / "package").mkdir()
        (folder / "package" / "__init__.py").write_text(PAYLOAD.format(mark=str(mark)))
        (folder / "names").mkdir()
        shutil.copy(folder / "evil.py", folder / "names" / "deep.py")
    code = folder / "evil.py"

    def searched(name: str) -> Callable[[], object]:
        def run() -> None:
            sys.path.insert(0, str(folder))
            try:
                importlib.import_module(name)
            finally:
                sys.path.remove(str(folder))
                sys.modules.pop(name, None)

        return run

    def by_spec() -> None:
        spec = importlib.util.spec_from_file_location("any", code)
        assert spec is not None and spec.loader is not None
        spec.loader.exec_module(importlib.util.module_from_spec(spec))

    def by_path() -> None:
        import runpy

        runpy.run_path(str(code))

    def in_a_package() -> None:
        import json

        json.__path__.append(str(folder))
        try:
            importlib.import_module("json.evil")
        finally:
            json.__path__.remove(str(folder))

    return {
        "sys.path": searched("evil"),
        "a package": searched("package"),
        "a namespace": searched("names.deep"),
        "a file": by_spec,
        "runpy": by_path,
        "exec": lambda: exec(compile(code.read_text(), str(code), "exec")),
        "a package's path": in_a_package,
    }


WAYS = ("sys.path", "a package", "a namespace", "a file", "runpy", "exec", "a package's path")


@pytest.mark.parametrize("way", WAYS)
def test_no_module_from_elsewhere_is_run(tmp_path: Path, mark: Path, way: str) -> None:
    with locked(), pytest.raises((VlaEvalError, ImportError)):
        modules(tmp_path / "elsewhere", mark)[way]()


@pytest.mark.parametrize("way", ["a namespace", "a file", "exec"])
def test_a_checkpoint_within_a_folder_of_packages_is_not_trusted_for_that(
    tmp_path: Path, mark: Path, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A project that is installed as editable has its folder on `sys.path`, and its checkpoints within it."""
    monkeypatch.syspath_prepend(tmp_path)
    with locked():
        distrust(tmp_path / "elsewhere")
        with pytest.raises((VlaEvalError, ImportError)):
            modules(tmp_path / "elsewhere", mark)[way]()


def test_modules_of_a_documented_pythonpath_are_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_own_policy.py").write_text("answer = 42")
    with locked():
        assert importlib.import_module("my_own_policy").answer == 42
        assert importlib.import_module("wave").__name__ == "wave"
    sys.modules.pop("my_own_policy")


def test_installed_modules_are_compiled_once_also_if_none_of_their_folder_was_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder for compiled modules is not there in a fresh checkout; elsewhere none is made."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.syspath_prepend(tmp_path / "installed")
    (tmp_path / "installed").mkdir()
    (tmp_path / "installed" / "compiled_once.py").write_text("answer = 42")
    with locked():
        assert importlib.import_module("compiled_once").answer == 42
        with pytest.raises(LockedError):
            (tmp_path / "__pycache__").mkdir()
    sys.modules.pop("compiled_once")
    assert list((tmp_path / "installed" / "__pycache__").glob("compiled_once.*.pyc"))


def test_what_libraries_need_goes_on() -> None:
    import ctypes.util
    from collections import namedtuple
    from dataclasses import make_dataclass

    with locked():
        assert ctypes.util.find_library("c")
        platform._uname_cache = None  # type: ignore[attr-defined]
        assert platform.processor() is not None
        assert namedtuple("A", "b")(1).b == 1  # made by `exec`
        assert make_dataclass("B", ["c"])(2).c == 2


def test_a_policy_of_ones_own_may_do_what_it_likes(tmp_path: Path) -> None:
    with locked():
        let_everything("a test")
        subprocess.run(["touch", str(tmp_path / "made")], check=True)
    with locked(), pytest.raises(LockedError):
        (tmp_path / "other").touch()


def test_the_lock_is_off_by_a_named_flag_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OFF_VARIABLE, "1")
    with locked():
        (tmp_path / "made").touch()


def test_the_lock_leaves_nothing_behind(tmp_path: Path) -> None:
    before = list(sys.meta_path)
    with pytest.raises(ZeroDivisionError), locked():
        let_connect("a test")
        _ = 1 / 0
    assert sys.meta_path == before and not STATE.is_on and STATE.network is None
    (tmp_path / "made").touch()


def test_every_event_that_is_refused_exists() -> None:
    """A misspelt one would never come. Python's own list is in its documentation, and in its sources."""
    library = Path(os.__file__).parent
    binary = Path(sys.executable).resolve().read_bytes()
    shared = b"".join(path.read_bytes() for path in library.parent.glob("libpython*.so*"))
    shared += b"".join(path.read_bytes() for path in (library / "lib-dynload").glob("_socket*.so"))
    python = "".join((library / name).read_text() for name in ("subprocess.py", "pty.py", "os.py"))
    for event in _CHECKS:
        assert event.encode() in binary + shared or event in python, event


def test_a_state_begins_with_nothing_let_through() -> None:
    state = State()
    assert not state.refuses and not state.writes and state.network is None and state.everything is None
