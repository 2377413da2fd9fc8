"""Connect to a Ray cluster, or start one; the only file that imports Ray, which is an engine here."""

import contextlib
import importlib
import os
import re
import socket
from collections.abc import Iterator
from typing import Any  # Ray is optional: not looked at by mypy

from vla_eval.errors import ClusterError, MissingDependencyError, RecipeError
from vla_eval.lock.switch import let_connect, own_need
from vla_eval.workers.start import available_cores, visible_gpus

OBJECT_STORE_BYTES = 100 << 20  # jobs and answers have a few kilobytes, and do not go through it
CONNECT_SECONDS = 10.0
ADDRESS = re.compile(r"(ray://)?[^\s/:]+:\d{1,5}")
LOCAL_VARIABLES = {
    # Ray's own switch for "this cluster stays on this machine": its ports are bound to the loopback address.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    # Each would take 100 MB, and only the workers that are asked for have something to do.
    "RAY_enable_worker_prestart": "0",
    "RAY_prestart_worker_first_driver": "0",
    "RAY_worker_niceness": "0",  # workers of the process pool do not stand back either
}


def check_address(text: str) -> str:
    """Return the value of `--cluster`, or raise `RecipeError`."""
    if text in ("auto", "local") or ADDRESS.fullmatch(text):
        return text
    raise RecipeError(
        f"--cluster {text:.80}: expected auto (the cluster that this machine belongs to), local (start one "
        f"on this machine), ray://HOST:PORT or HOST:PORT."
    )


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Give the module `ray`, connected to the address from `check_address`; disconnect in the end."""
    if address == "local":
        os.environ.update({name: os.environ.get(name, value) for name, value in LOCAL_VARIABLES.items()})
    ray = load_ray()
    if ray.is_initialized():  # by the caller, as tests do: it stays
        yield ray
        return
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == "local":
        quiet |= {
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
            "num_cpus": available_cores(),
            "num_gpus": len(visible_gpus()),
        }
    if not address.startswith("ray://"):
        quiet["job_config"] = _without_working_directory(ray)
    try:
        let_connect(f"--cluster {address}")
        _check_listening(address)
        with own_need():
            ray.init(address=address, **quiet)
    except ImportError as exc:
        raise _missing(exc) from exc
    except (OSError, OverflowError, RuntimeError, ValueError, ray.exceptions.RayError) as exc:
        raise ClusterError(
            f"--cluster {address}: there is no cluster to connect to ({exc}). Start one with `ray start "
            f"--head` (docs/cluster.md), name its address, or use --cluster local."
        ) from exc
    try:
        yield ray
    finally:
        ray.shutdown()


def _without_working_directory(ray: Any) -> Any:
    """Keep Ray from importing from the driver's working directory, for which there is no public switch."""
    config = ray.job_config.JobConfig()
    config._runtime_env_has_working_dir = lambda: True
    return config


def _check_listening(address: str) -> None:
    """Raise `OSError` if nobody listens there: Ray would try for minutes."""
    if address not in ("auto", "local"):
        host, _, port = address.removeprefix("ray://").rpartition(":")
        socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()


def on_machine(node: str) -> Any:
    """Return Ray's strategy for: on the machine with this id, or not at all."""
    strategies: Any = importlib.import_module("ray.util.scheduling_strategies")
    return strategies.NodeAffinitySchedulingStrategy(node_id=node, soft=False)


def load_ray() -> Any:
    """Import Ray, or raise `MissingDependencyError`."""
    try:
        return importlib.import_module("ray")
    except ImportError as exc:
        raise _missing(exc) from exc


def _missing(exc: ImportError) -> MissingDependencyError:
    return MissingDependencyError(
        f"--cluster: the package '{exc.name or 'ray'}' is not installed. Install it with pip install "
        "'mikasa-vla-eval[cluster]', or leave --cluster out."
    )
