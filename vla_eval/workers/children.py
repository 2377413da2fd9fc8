"""What all child processes have in common: where they import from, and that they end with their parent.

A dataset, a checkpoint or a run folder may hold a `numpy.py`, and people start commands in such folders.
Python searches the working directory for modules if it is started by `-c` or `-m`: multiprocessing does that.
"""

import contextlib
import os
import sys
from pathlib import Path

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable: Python does not search the working directory."""
SEARCH_PATH = "PYTHONPATH"
MODULE = "vla_eval.cli.__main__"
CHECKOUT = Path(__file__).resolve().parents[2]

# The bond outlives the last line; the parent may have died before it was made.
_BIND_AND_EXECUTE = """import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
os.getppid() == int(sys.argv[1]) or os._exit(1)
os.execv(sys.argv[2], sys.argv[2:])"""


def leave_working_directory() -> None:
    """Keep the working directory out of the search for modules, in this process and in its children.

    What `PYTHONPATH` names is searched, also `.`; an empty entry, as in `PYTHONPATH=$PYTHONPATH:DIR`, names
    nothing. A checkout of this package that `python -m` was started in stays, for children by its name.
    """
    os.environ[SAFE_PATH] = "1"
    search_path = os.environ.get(SEARCH_PATH, "")
    named = [entry for entry in search_path.split(os.pathsep) if entry]
    with contextlib.suppress(FileNotFoundError):  # the working directory was deleted: nothing to search
        here = os.getcwd()
        has_empty_entry = search_path not in ("", os.pathsep.join(named))
        spec = getattr(sys.modules["__main__"], "__spec__", None)
        is_started_as_module = spec is not None and spec.name == MODULE
        is_first = not sys.flags.safe_path and sys.path[:1] == [here] and is_started_as_module
        if (has_empty_entry or is_first) and not any(os.path.realpath(entry) == here for entry in named):
            if Path(here) == CHECKOUT:
                named.insert(0, here)
            elif here in sys.path:
                sys.path.remove(here)
    sys.path[:] = [entry for entry in sys.path if entry]  # multiprocessing replaces "" by the folder
    if named:
        os.environ[SEARCH_PATH] = os.pathsep.join(named)
    else:
        os.environ.pop(SEARCH_PATH, None)


def python_command(*arguments: str) -> list[str]:
    """Return a command for this Python that does not search the working directory and ends with us."""
    return bound_command(sys.executable, "-P", *arguments)


def bound_command(program: str, *arguments: str) -> list[str]:
    """Return a command that is killed when the thread that starts it ends, however that happens."""
    # Isolated: it takes a hundredth of a second, and imports nothing from anywhere else.
    binding = [sys.executable, "-I", "-S", "-c", _BIND_AND_EXECUTE, str(os.getpid())]
    return [*binding, program, *arguments]
