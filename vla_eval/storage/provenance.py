"""What an evaluation was run with: commit, package versions, CPU, drivers.

Two calls on an unchanged machine give the same answer, which is how a continued run notices that the
machine or the code has changed. Nothing here names a host, a user or a folder. Standard library only.
"""

import functools
import hashlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
from pathlib import Path

import vla_eval
from vla_eval.lock.switch import own_need
from vla_eval.storage.run_file import JsonValue

PACKAGE_FOLDER = Path(vla_eval.__file__).parent
PACKAGES = ("torch", "mani_skill", "sapien", "gymnasium", "numpy", "scipy", "lerobot")
"""Foreign packages whose version can move a result."""

HASH_DIGITS = 12
NVIDIA_VERSION_FILE = Path("/proc/driver/nvidia/version")
CPUINFO_FILE = Path("/proc/cpuinfo")
TOOL_TIMEOUT_SECONDS = 30.0
ICD_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
ICD_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")


def collect_environment() -> dict[str, JsonValue]:
    """Return what results may depend on and no configuration says; see also `checkout_state`."""
    return {
        "vla_eval": {"version": vla_eval.__version__, **checkout_state(PACKAGE_FOLDER)},
        "packages": {name: package_version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "cpu": cpu_model(),
        "mesa": mesa_version(),
        "nvidia_driver": nvidia_driver_version(),
    }


def checkout_state(package: Path) -> dict[str, str | None]:
    """Return commit (full hash) and digest of changes of a checkout; None without git."""
    unknown: dict[str, str | None] = {"commit": None, "changes": None}
    root = package.parent
    if not (root / ".git").exists():
        return unknown
    commit = _git(root, "rev-parse", "HEAD")
    diff = _git(root, "diff", "HEAD", "--binary", "--no-color", "--no-ext-diff", "--", package.name)
    added = _git(root, "ls-files", "-z", "--others", "--exclude-standard", "--", package.name)
    if commit is None or diff is None or added is None:
        return unknown
    return {"commit": commit.decode().strip(), "changes": _digest_changes(root, diff, added)}


@functools.cache  # what is imported stays as it is
def package_version(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def cpu_model() -> str | None:
    """Return the CPU's name as Linux gives it; images rendered on a CPU may depend on it."""
    match = re.search(r"^model name\s*:\s*(.+)$", _read(CPUINFO_FILE), re.MULTILINE)
    return match[1].strip() if match else None


def nvidia_driver_version() -> str | None:
    """Return the version of the loaded NVIDIA kernel module, or None without one."""
    match = re.search(r"Kernel Module.*?\s(\d+\.\d+(?:\.\d+)*)\s", _read(NVIDIA_VERSION_FILE))
    return match[1] if match else None


@functools.cache
def mesa_version() -> str | None:
    """Return the version of Mesa's Vulkan drivers where dpkg knows it, such as `25.0.7-2~bpo12+1`."""
    if shutil.which("dpkg-query") is None:
        return None
    query = ("dpkg-query", "-W", "-f", "${db:Status-Status} ${Version}\n", "mesa-vulkan-drivers")
    # One line per architecture; "config-files" is what is left of a removed package.
    lines = (_output(query) or b"").decode().splitlines()
    return next((line.split()[1] for line in lines if line.startswith("installed ")), None)


def vulkan_drivers() -> tuple[str, ...]:
    """Return the names of the Vulkan drivers that are registered, such as `lvp_icd.x86_64`."""
    named = [path for key in ICD_VARIABLES for path in os.environ.get(key, "").split(":") if path]
    found = [path for folder in ICD_FOLDERS for path in sorted(Path(folder).glob("*.json"))]
    return tuple(Path(path).stem for path in (named or found) if Path(path).is_file())


def _digest_changes(root: Path, diff: bytes, added: bytes) -> str | None:
    names = sorted(name for name in added.split(b"\0") if name)
    if not diff and not names:
        return None
    digest = hashlib.sha256(diff)
    for name in names:
        digest.update(name + b"\0" + hashlib.sha256(_bytes(root / os.fsdecode(name))).digest())
    return digest.hexdigest()[:HASH_DIGITS]


def _git(root: Path, *arguments: str) -> bytes | None:
    # Inside a hook, git's variables point to another repository. No lock: others may be committing.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    environment["GIT_OPTIONAL_LOCKS"] = "0"
    return _output(("git", "-C", str(root), *arguments), environment)


def _output(command: tuple[str, ...], environment: dict[str, str] | None = None) -> bytes | None:
    """Return what a tool prints, or None if it is missing, fails or hangs."""
    try:
        with own_need():
            done = subprocess.run(
                command, capture_output=True, env=environment, check=True, timeout=TOOL_TIMEOUT_SECONDS
            )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


def _read(path: Path) -> str:
    return _bytes(path).decode("utf-8", errors="replace")


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
