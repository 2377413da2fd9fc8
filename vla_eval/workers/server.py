"""Imported by the process that workers are forked from; see `vla_eval.workers.start`."""

import contextlib
import errno
import functools
import gc
import importlib.metadata
import os
import socket
from collections.abc import Iterator
from multiprocessing import reduction

from vla_eval.lock.state import code_folders
from vla_eval.workers.guard import end_with_parent

IMPORTS_VARIABLE = "MIKASA_VLA_WORKER_IMPORTS"
"""Environment variable: names of further modules to import, separated by colons."""
PARENT_VARIABLE = "MIKASA_VLA_WORKER_PARENT"
"""Environment variable: process id of the command, whose end would be noticed only after the imports."""


def import_for_workers() -> None:
    """Import the modules that workers need; a worker reports a failed import as the error of an episode.

    No garbage is collected meanwhile, which would take a quarter of the time: what a module makes stays.
    What is there at the end is left out of every later collection, so that workers keep sharing its memory.
    """
    gc.disable()
    with _packages_asked_for_once():
        for name in filter(None, os.environ.get(IMPORTS_VARIABLE, "").split(":")):
            with contextlib.suppress(Exception):
                importlib.import_module(name)
    code_folders()  # resolves the folder of each module, so that no worker has to
    gc.freeze()
    gc.enable()


@contextlib.contextmanager
def _packages_asked_for_once() -> Iterator[None]:
    """Let Python look only once for what is installed: transformers and diffusers ask, 0.7 CPU s each."""
    original = importlib.metadata.packages_distributions
    setattr(importlib.metadata, "packages_distributions", functools.cache(original))  # noqa: B010
    try:
        yield
    finally:
        setattr(importlib.metadata, "packages_distributions", original)  # noqa: B010


_receive = reduction.recvfds


def _receive_or_wait_for_the_next(sock: socket.socket, size: int) -> list[int]:
    """Receive what a process sends that asks for a worker.

    If it was killed before it could send, multiprocessing's server would end, with a traceback. An aborted
    connection is the one thing after which it waits for the next.
    """
    try:
        return _receive(sock, size)
    except EOFError as exc:
        raise ConnectionAbortedError(errno.ECONNABORTED, "it was killed before it could send") from exc


if IMPORTS_VARIABLE in os.environ:  # else this module is imported for its names
    end_with_parent(int(os.environ[PARENT_VARIABLE]))
    os.setsid()  # signals to the command's group are for the command, which then ends its workers
    import_for_workers()
    reduction.recvfds = _receive_or_wait_for_the_next
