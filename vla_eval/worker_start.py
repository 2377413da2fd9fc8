"""How worker processes begin: forked from one server that has imported what takes long.

Importing torch, ManiSkill and lerobot takes seconds and hundreds of megabytes, for every worker and again
after every error; a fork has them at once, and shares the memory. Where there is an NVIDIA driver each
worker starts from nothing: a CUDA context does not survive a fork, and an import may open one.
"""

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.context import ForkServerContext, SpawnContext

from vla_eval.envs.settings import Simulator
from vla_eval.provenance import nvidia_driver_version
from vla_eval.worker_server import IMPORTS_VARIABLE

SERVER_MODULE = "vla_eval.worker_server"

# One thread per worker: several workers share the cores, and sums do not depend on the number of threads.
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}

_preloaded: dict[str, None] = {}


def worker_context(*, preload: Sequence[str] = ()) -> ForkServerContext | SpawnContext:
    """Return what makes worker processes.

    Args:
        preload: modules that the server imports before the first fork. The server starts with the first
            worker of this process; what is named later, workers import.
    """
    if nvidia_driver_version() is not None:
        return multiprocessing.get_context("spawn")
    _preloaded.update(dict.fromkeys(preload))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([SERVER_MODULE])
    return context


def simulator_modules(simulator: Simulator) -> tuple[str, ...]:
    """Return what workers that run a simulator need and what takes long to import."""
    return ("vla_eval.envs.maniskill",) if simulator == "maniskill" else ()


def begin(environment: Mapping[str, str], main: Callable[..., None], *args: object) -> None:
    """Run `main` in a worker as if the process had been started with this environment.

    The server keeps the environment of its own start, which may be of an earlier pool.
    """
    os.environ.clear()
    os.environ.update(environment)
    main(*args)


@contextlib.contextmanager
def worker_environment() -> Iterator[Mapping[str, str]]:
    """Set the environment variables that a new process reads when it starts, unless the user has set them."""
    added = {name: value for name, value in WORKER_ENVIRONMENT.items() if name not in os.environ}
    os.environ.update(added)
    try:
        environment = dict(os.environ)
        os.environ[IMPORTS_VARIABLE] = ":".join(_preloaded)
        yield environment
    finally:
        for name in (*added, IMPORTS_VARIABLE):
            os.environ.pop(name, None)
