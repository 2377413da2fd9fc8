"""Environments of their own, made by uv from the package registry; only for tests that are marked `peer`."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.peers.programs import run_python

OLDER = ("3.8", "3.9", "3.10", "3.11")
MakeEnvironment = Callable[..., Path]


def older_python() -> str:
    """Return the oldest Python here that is older than what this package needs, or skip."""
    named = os.environ.get("MIKASA_PEER_PYTHON")
    found = [named]
    for version in OLDER:
        of_pyenv = sorted((Path.home() / ".pyenv/versions").glob(f"{version}.*/bin/python"))
        found += [shutil.which(f"python{version}"), *map(str, of_pyenv)]
    for python in found:
        # What pyenv puts on PATH may be a name without a Python.
        if python and subprocess.run([python, "-c", ""], capture_output=True).returncode == 0:
            return python
    pytest.skip("no Python from 3.8 to 3.11; name one with MIKASA_PEER_PYTHON")


@pytest.fixture(scope="session")
def make_environment(tmp_path_factory: pytest.TempPathFactory) -> MakeEnvironment:
    """Return a function: packages -> the Python of a new environment that has them."""

    def make(*packages: str, python: str | None = None) -> Path:
        folder = tmp_path_factory.mktemp("environment")
        uv = [sys.executable, "-m", "uv"]
        subprocess.run([*uv, "venv", "-q", "--python", python or older_python(), folder / "venv"], check=True)
        made = folder / "venv" / "bin" / "python"
        subprocess.run([*uv, "pip", "install", "-q", "--python", made, *packages], check=True)
        return made

    return make


def versions(python: Path, *packages: str) -> dict[str, str]:
    """Return what is installed there, and the version of Python."""
    script = (
        "import sys, platform\n"
        "from importlib.metadata import version\n"
        "print(platform.python_version(), *[version(name) for name in sys.argv[1:]])"
    )
    done = run_python(python, "-c", script, *packages)
    assert done.returncode == 0, done.stderr
    return dict(zip(("python", *packages), done.stdout.split(), strict=True))
