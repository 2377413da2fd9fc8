"""Imported by the process that workers are forked from; see `vla_eval.workers.start`."""

import contextlib
import importlib
import os

IMPORTS_VARIABLE = "MIKASA_VLA_WORKER_IMPORTS"
"""Environment variable: names of further modules to import, separated by colons."""


def import_for_workers() -> None:
    """Import the modules that workers need; a worker reports a failed import as the error of an episode."""
    for name in filter(None, os.environ.get(IMPORTS_VARIABLE, "").split(":")):
        with contextlib.suppress(Exception):
            importlib.import_module(name)


if IMPORTS_VARIABLE in os.environ:  # else this module is imported for its names
    os.setsid()  # signals to the command's group are for the command, which then ends its workers
    import_for_workers()
