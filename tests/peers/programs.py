"""Programs of other people, or for them, as processes: started on a free port, ended by the test."""

import contextlib
import http.client
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
PLUGIN = ROOT / "plugins" / "mikasa_vla_client"
START_SECONDS = 60.0
PROGRAM_SECONDS = 120.0


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


def elsewhere() -> dict[str, str]:
    """Return the variables for a program that must not find our packages."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def with_path(*folders: Path) -> dict[str, str]:
    """Return the variables for a program that finds the packages in these folders."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}


def run_python(python: Path, *arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a program of another environment to its end."""
    command = [str(python), *arguments]
    return subprocess.run(
        command, cwd=cwd, env=elsewhere(), capture_output=True, text=True, timeout=PROGRAM_SECONDS
    )


def example(page: str, name: str) -> str:
    """Return the first Python block after the name of a file in a page of the documentation."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    block = text[text.index(f"`{name}`") :].split("```python\n", 1)[1]
    return block.split("```", 1)[0]


@contextlib.contextmanager
def running(
    command: Sequence[str | Path],
    port: int,
    *,
    cwd: Path,
    health: str = "/healthz",
    env: Mapping[str, str] | None = None,
) -> Iterator[subprocess.Popen[str]]:
    """Start a server, wait until it is healthy, and kill it at the end; its output is in `server.log`."""
    with (cwd / "server.log").open("a") as log:
        process = subprocess.Popen(
            list(map(str, command)), cwd=cwd, env=env or elsewhere(), stdout=log, stderr=log, text=True
        )
    try:
        deadline = time.monotonic() + START_SECONDS
        while not is_healthy(port, health):
            assert process.poll() is None, (cwd / "server.log").read_text()
            assert time.monotonic() < deadline, "the server does not answer"
            time.sleep(0.1)
        yield process
    finally:
        process.kill()
        process.wait()


def is_healthy(port: int, path: str) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", path)
        return connection.getresponse().status == 200
    except OSError:
        return False
    finally:
        connection.close()


def mikasa_vla(*arguments: str | Path, code: int = 0) -> str:
    """Run the command in a process of its own; return what it printed."""
    command = [sys.executable, "-m", "vla_eval.cli", *map(str, arguments)]
    done = subprocess.run(command, env=with_path(ROOT), capture_output=True, text=True)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr
