"""The process between a worker and its parent: ends all processes of the worker when the worker ends.

A policy may start daemons, which leave the worker's session. The guard is a *subreaper*: the kernel makes it
the parent of every descendant that has lost its own. It ends them all when the worker or the parent ends, and
exits as the worker did. If the guard is killed, the kernel kills the worker.
"""

import contextlib
import ctypes
import os
import resource
import select
import signal
import time
import traceback
from collections.abc import Iterator
from multiprocessing.connection import Connection

import psutil

ASK_WHERE = b"?"
"""Sent by the parent: the worker writes the stack of every thread to its log."""
END = b"e"
"""Sent by the parent: end the worker. So does closing the connection, which the parent's death does."""

REAP_SECONDS = 5.0  # a process that sits in a driver may survive SIGKILL for a while; continue without it
PR_SET_PDEATHSIG = 1  # linux/prctl.h
PR_SET_CHILD_SUBREAPER = 36


def fork_guarded(lifeline: Connection) -> None:
    """Return in a child of this process, which stays behind as its guard and obeys `ASK_WHERE` and `END`."""
    with contextlib.suppress(PermissionError):  # a leader of a group is alone in it already
        os.setsid()  # signals to the command's group are for the command
    become_subreaper()
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    before = {number: signal.signal(number, lambda *_: None) for number in (signal.SIGCHLD, signal.SIGTERM)}
    before_fd = signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    guard = os.getpid()
    worker = os.fork()
    if worker:
        _guard(worker, lifeline.fileno(), woken, wake)
    signal.set_wakeup_fd(before_fd)
    for number, handler in before.items():
        signal.signal(number, handler)
    os.close(woken)
    os.close(wake)
    lifeline.close()
    end_with_parent(guard)


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its parent ends, or the thread of the parent that started it."""
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the line above
        os._exit(1)


def become_subreaper() -> None:
    """Become the parent of every descendant that loses its own."""
    _prctl(PR_SET_CHILD_SUBREAPER, 1)


def _guard(worker: int, lifeline: int, woken: int, wake: int) -> None:
    """Wait for the worker or the parent to end, end all descendants, and end as the worker did."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _close_all_but(lifeline, woken, wake)
        status = _wait(worker, lifeline, woken)
        end_descendants()
        _end_as(status)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)


def _wait(worker: int, lifeline: int, woken: int) -> int:
    """Return the worker's wait status; 0 if it is to be ended now."""
    poll = select.poll()
    poll.register(lifeline, select.POLLIN)
    poll.register(woken, select.POLLIN)
    while True:
        ready = {descriptor for descriptor, _ in poll.poll()}
        signals = os.read(woken, 64) if woken in ready else b""
        for pid, status in _reaped():
            if pid == worker:
                return status
        request = os.read(lifeline, 1) if lifeline in ready else None
        if signal.SIGTERM in signals or request in (b"", END):
            return 0
        if request == ASK_WHERE:
            os.kill(worker, signal.SIGUSR1)


def end_descendants() -> None:
    """Kill all descendants of this process, which must be a subreaper; wait until they are gone."""
    deadline, pause_seconds = time.monotonic() + REAP_SECONDS, 0.001
    while True:
        processes = psutil.Process().children(recursive=True)
        for process in processes:
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):  # gone, or another user's
                process.kill()
        list(_reaped())
        if not processes or time.monotonic() > deadline:
            return
        time.sleep(pause_seconds)
        pause_seconds = min(2 * pause_seconds, 0.05)


def _reaped() -> Iterator[tuple[int, int]]:
    """Yield pid and wait status of each child that has ended."""
    with contextlib.suppress(ChildProcessError):
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            yield pid, status


def _end_as(status: int) -> None:
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # the worker has dumped its core; one is enough
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _close_all_but(*kept: int) -> None:
    """Close what was inherited: a copy would hide from the parent that the worker has closed its own."""
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2 and int(name) not in kept:  # standard input, output and error
            with contextlib.suppress(OSError):
                os.close(int(name))


def _prctl(option: int, value: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(option, ctypes.c_ulong(value), 0, 0, 0):
        number = ctypes.get_errno()
        raise OSError(number, f"prctl({option}): {os.strerror(number)}")
