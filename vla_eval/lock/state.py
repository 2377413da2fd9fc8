"""What this process may do, and whether a path is within it: one state, as there is one audit hook."""

import functools
import getpass
import importlib.abc
import os
import sys
import tempfile
import threading
from dataclasses import dataclass, field

TEMPORARY = ("tmp", "pymp-", "mikasa-vla-", "torch", "ray", "wandb", ".wandb", "matplotlib-", "gradio")
"""Beginnings of the names that Python and libraries give to temporary folders and files."""
CACHE_VARIABLES = (
    *("XDG_CACHE_HOME", "HF_HOME", "HF_HUB_CACHE", "HF_DATASETS_CACHE", "HF_LEROBOT_HOME", "TORCH_HOME"),
    *("TRITON_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR", "MPLCONFIGDIR", "NUMBA_CACHE_DIR", "MS_ASSET_DIR"),
    *("WANDB_DIR", "WANDB_CACHE_DIR", "WANDB_CONFIG_DIR", "WANDB_DATA_DIR", "TRACKIO_DIR"),
)
CACHES = (
    *(".cache", ".triton", ".nv", ".maniskill"),
    *(".config/matplotlib", ".config/wandb", ".local/share/wandb"),
)
"""Folders of libraries below the home folder."""
DEVICES = ("/dev", "/proc")
COMPILED_VARIABLES = ("TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR")
"""Folders from which torch runs the Python that it has written there."""


@dataclass
class State:
    """What this process may do."""

    is_on: bool = False  # whether anything is refused at all
    has_hook: bool = False  # whether the audit hook is installed; it cannot be removed
    # why all connections, or all, are let through; None: they are not
    network: str | None = None
    everything: str | None = None
    code: tuple[str, ...] = ()  # folders that Python files may be run from
    # folders of checkpoints and datasets, which may lie within those of `code`
    foreign: set[str] = field(default_factory=set)
    tools: frozenset[str] = frozenset()  # programs of the system that libraries may start
    hosts: set[str] = field(default_factory=set)  # names that may be looked up
    writes: set[str] = field(default_factory=set)  # files and folders that may be written
    finder: importlib.abc.MetaPathFinder | None = None  # stands first in `sys.meta_path`
    # of each thread, how many `own_need` are open
    ours: threading.local = field(default_factory=threading.local)

    @property
    def refuses(self) -> bool:
        """Whether this thread is refused anything now."""
        return self.is_on and self.everything is None and not getattr(self.ours, "depth", None)


STATE = State()


def may_run(path: str) -> bool:
    """Whether a Python file or a program is installed: of the folders around it, the innermost decides."""
    folder, name = os.path.split(path)
    place = os.path.join(_resolved(folder or "."), name)
    around = [folder for folder in (*STATE.code, *STATE.foreign) if _is_within(place, folder)]
    return bool(around) and max(around, key=len) in STATE.code


def may_write(place: str) -> bool:
    """Whether a resolved path may be written: named by the user, a cache, temporary, or a compiled module."""
    drafts = (f"{named}." for named in STATE.writes)
    if any(_is_within(place, named) for named in STATE.writes) or place.startswith(tuple(drafts)):
        return True
    temporary = os.path.realpath(tempfile.gettempdir())
    if _is_within(place, temporary) and os.path.relpath(place, temporary).startswith(TEMPORARY):
        return True
    folder, name = os.path.split(place)
    return os.path.basename(folder) == "__pycache__" and ".pyc" in name and may_run(place)


def code_folders() -> tuple[str, ...]:
    """Return the folders that Python searches now, and those of packages that are installed elsewhere."""
    modules = [module for name, module in tuple(sys.modules.items()) if "." not in name]
    files = [getattr(module, "__file__", None) for module in modules]
    here = os.getcwd()
    elsewhere = {_resolved(os.path.join(here, os.path.dirname(file))) for file in files if file}
    elsewhere -= {"/", os.path.realpath(here)}
    compiled = os.path.join(tempfile.gettempdir(), f"torchinductor_{_user()}")
    named = [os.environ[name] for name in COMPILED_VARIABLES if os.environ.get(name)]
    searched = (*(place or "." for place in sys.path), sys.prefix, os.path.dirname(os.__file__))
    found = {*elsewhere, *map(os.path.realpath, (*searched, compiled, *named))}
    return tuple(sorted(found - {_cache_of_modules()}))


def _user() -> str:
    """Return the user's name; in a container that knows only a number, torch and we use that."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return os.environ.setdefault("LOGNAME", str(os.getuid()))


def _cache_of_modules() -> str:
    """Return where transformers copies code of checkpoints to; it puts this folder on `sys.path`."""
    home = os.environ.get("HF_HOME", os.path.join(os.path.expanduser("~"), ".cache", "huggingface"))
    return os.path.realpath(os.environ.get("HF_MODULES_CACHE", os.path.join(home, "modules")))


def library_folders() -> set[str]:
    """Return the folders that libraries keep their caches in, and those of devices."""
    named = [os.environ[name] for name in CACHE_VARIABLES if os.environ.get(name)]
    at_home = (os.path.join(os.path.expanduser("~"), name) for name in CACHES)
    return {os.path.realpath(folder) for folder in (*named, *at_home, *DEVICES)}


@functools.cache
def _resolved(folder: str) -> str:
    return os.path.realpath(folder)


def _is_within(place: str, folder: str) -> bool:
    return place == folder or place.startswith(f"{folder.rstrip('/')}/")
