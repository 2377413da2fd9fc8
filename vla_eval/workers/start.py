"""Start worker processes: forked from one server that has done the slow imports.

A fork has torch, ManiSkill and lerobot at once, and shares their memory. Where there is an NVIDIA driver each
worker starts from nothing: a CUDA context does not survive a fork, and an import may open one.
"""

import contextlib
import multiprocessing
import os
import queue
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from multiprocessing import forkserver, resource_tracker, spawn
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext, SpawnProcess
from typing import Any  # private parts of multiprocessing

import psutil

from vla_eval.lock.switch import WRITING_VARIABLE, folders_for_workers, lock
from vla_eval.storage.provenance import nvidia_driver_version
from vla_eval.workers.children import SAFE_PATH
from vla_eval.workers.guard import end_with_parent, fork_guarded
from vla_eval.workers.server import IMPORTS_VARIABLE, PARENT_VARIABLE, import_for_workers

SERVER_MODULE = "vla_eval.workers.server"
PROCESS_NAME = "mikasa-vla"
"""How the names of our processes begin."""

NEAR_VARIABLE = "MIKASA_VLA_NEAR"
"""Environment variable of a cluster's workers: the address of their machine; servers there are preferred."""
VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
_GPU_DEVICE = re.compile(r"nvidia\d+")

# One thread per worker: several workers share the cores. A server has one, too: the sums of a pass of several
# rows depend on the number of threads.
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0", SAFE_PATH: "1"}

_preloaded: dict[str, None] = {}
_environment_lock = threading.Lock()  # several workers may be starting at once
_starts: "queue.SimpleQueue[tuple[Future[None], Callable[[], None]]]" = queue.SimpleQueue()
_starter: threading.Thread | None = None

_preparation: Callable[[str], dict[str, Any]] = spawn.get_preparation_data


def _without_script(name: str) -> dict[str, Any]:
    """Return what multiprocessing tells a new process; ours do not run the user's script again.

    multiprocessing would, and has no option against it: a script without a main guard would start over.
    """
    told = _preparation(name)
    if name.startswith(PROCESS_NAME):
        return {key: value for key, value in told.items() if not key.startswith("init_main_from")}
    return told


spawn.get_preparation_data = _without_script


def worker_context(*, preload: Sequence[str] = ()) -> ForkServerContext | SpawnContext:
    """Return what makes worker processes, from a server that imports `preload` before the first fork."""
    if nvidia_driver_version() is not None:
        return multiprocessing.get_context("spawn")
    _preloaded.update(dict.fromkeys(preload))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([SERVER_MODULE])
    return context


def start_server(preload: Sequence[str]) -> None:
    """Begin the slow imports of workers to come; returns at once."""
    if isinstance(worker_context(preload=preload), ForkServerContext):
        start_by_lasting_thread(_start_server)


def _start_server() -> None:
    with worker_environment(), contextlib.suppress(OSError):  # which a worker's start will report
        forkserver.ensure_running()


def begin(
    environment: Mapping[str, str], lifeline: Connection, main: Callable[..., None], *args: object
) -> None:
    """Run `main` in a guarded worker with this environment; the server keeps that of its own start."""
    fork_guarded(lifeline)
    # Close the pipes to the server and to multiprocessing's resource tracker: both end with a traceback if a
    # policy writes into what it has inherited. The tracker is started again if the worker needs one.
    owners: tuple[tuple[Any, str], ...] = (  # there are no public names
        (forkserver._forkserver, "_forkserver_alive_fd"),
        (resource_tracker._resource_tracker, "_fd"),
    )
    for owner, name in owners:
        descriptor: int | None = getattr(owner, name, None)
        if descriptor is not None:
            os.close(descriptor)
            setattr(owner, name, None)
    os.environ.clear()
    os.environ.update(environment)
    import_for_workers()  # SAPIEN runs a program when it is imported, which the lock would refuse
    del os.environ[IMPORTS_VARIABLE]
    lock()
    main(*args)


def server_is_stopped() -> bool:
    """Whether the process that workers are forked from was stopped by a signal: it would never answer."""
    pid = _server_pid()
    with contextlib.suppress(psutil.Error):
        return pid is not None and psutil.Process(pid).status() == psutil.STATUS_STOPPED
    return False


def end_server() -> None:
    """Kill the process that workers are forked from: it does not answer. The next worker starts another one.

    Workers are not touched; the kernel keeps the dead process until `multiprocessing` sees that it is gone.
    """
    pid = _server_pid()
    if pid is not None:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


def _server_pid() -> int | None:
    pid: int | None = getattr(forkserver._forkserver, "_forkserver_pid", None)  # there is no public name
    return pid


class _BoundProcess(SpawnProcess):
    """Bound to its parent before it imports what it is to run, which takes seconds."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # multiprocessing's own
        super().__init__(*args, **kwargs)
        self.name = f"{PROCESS_NAME} {self.name}"

    def __reduce__(self) -> tuple[Callable[[int], "_BoundProcess"], tuple[int], dict[str, Any]]:
        return _arrive, (os.getpid(),), self.__dict__


def _arrive(parent: int) -> _BoundProcess:
    end_with_parent(parent)
    return _BoundProcess.__new__(_BoundProcess)


class _BoundContext(SpawnContext):
    Process = _BoundProcess


def child_context() -> SpawnContext:
    """Return what makes processes that end with the thread that starts them."""
    return _BoundContext()


def start_by_lasting_thread(start: Callable[[], None]) -> None:
    """Start a process by a thread that lives as long as this process, and wait for that.

    The kernel counts a process's parent as gone when the thread that started it has ended.
    """
    global _starter
    with _environment_lock:
        if _starter is None or not _starter.is_alive():  # as in a fork of this process
            _starter = threading.Thread(target=_start_all, name="mikasa-vla starter", daemon=True)
            _starter.start()
    done: Future[None] = Future()
    _starts.put((done, start))
    done.result()


def _start_all() -> None:
    while True:
        done, start = _starts.get()
        try:
            start()
            done.set_result(None)
        except BaseException as exc:  # raised where it is awaited
            done.set_exception(exc)


@contextlib.contextmanager
def worker_environment() -> Iterator[Mapping[str, str]]:
    """Set the environment variables that a new process reads when it starts, unless the user has set them."""
    with _environment_lock:
        added = {name: value for name, value in WORKER_ENVIRONMENT.items() if name not in os.environ}
        os.environ.update(added)
        try:
            os.environ[IMPORTS_VARIABLE] = ":".join(_preloaded)
            environment = {**os.environ, WRITING_VARIABLE: folders_for_workers()}
            os.environ[PARENT_VARIABLE] = str(os.getpid())
            yield environment
        finally:
            for name in (*added, IMPORTS_VARIABLE, PARENT_VARIABLE):
                os.environ.pop(name, None)


def available_cores() -> int:
    """Return how many cores this process may use: of a machine's cores, clusters hand out a part."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_ram_bytes() -> int:
    """Return how much RAM a process may still take without swapping."""
    return int(psutil.virtual_memory().available)


def visible_gpus() -> tuple[str, ...]:
    """Return the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them; no torch is needed."""
    if nvidia_driver_version() is None:
        return ()
    named = os.environ.get(VISIBLE_GPUS)
    if named is not None:
        return tuple(name.strip() for name in named.split(",") if name.strip() not in ("", "-1"))
    n_devices = sum(_GPU_DEVICE.fullmatch(name) is not None for name in os.listdir("/dev"))
    return tuple(str(index) for index in range(n_devices))
