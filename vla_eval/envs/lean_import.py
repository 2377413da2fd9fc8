"""Import ManiSkill without running what it imports at its top and hardly uses: 0.55 of 1.4 CPU seconds.

A module of `LATER` is found at once, and runs when any code first asks for one of its names. Modules
that ManiSkill does not import while it is imported, or that are not plain Python files, are not touched.
"""

import contextlib
import sys
import threading
from collections.abc import Collection, Iterator
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader
from types import ModuleType
from typing import Any  # specs of modules, and what is in modules

LATER = (
    *("matplotlib.pyplot", "matplotlib.animation"),  # to show images
    "mani_skill.utils.download_asset",  # brings a client for the Hub
    *("scipy.optimize", "scipy.ndimage", "trimesh.nsphere", "trimesh.path.simplify"),  # by trimesh
)
_running = threading.RLock()


class _LaterModule(ModuleType):
    """A module that was found and did not run yet."""

    def __getattr__(self, name: str) -> Any:
        with _running:  # other threads wait until it has run
            own, spec = vars(self), vars(self)["__spec__"]
            if type(self) is _LaterModule and not own.get("__running__"):
                own["__running__"] = True
                if spec.submodule_search_locations is not None:
                    own["__path__"] = spec.submodule_search_locations
                try:
                    spec.loader.exec_module(self)
                    self.__class__ = ModuleType  # type: ignore[assignment]
                finally:
                    del own["__running__"]
        return ModuleType.__getattribute__(self, name)


class _Later(MetaPathFinder, Loader):
    """Finds modules, and leaves them as it found them."""

    def __init__(self, names: Collection[str]) -> None:
        self._names = names

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        spec = PathFinder.find_spec(fullname, path, target) if fullname in self._names else None
        if spec is None or type(spec.loader) is not SourceFileLoader:
            return None  # the other finders decide
        spec.loader_state, spec.loader = spec.loader, self
        return spec

    def exec_module(self, module: Any) -> None:
        module.__spec__.loader = module.__loader__ = module.__spec__.loader_state
        vars(module).pop("__path__", None)  # so that the import of a submodule runs its package first
        module.__class__ = _LaterModule


@contextlib.contextmanager
def running_later(names: Collection[str]) -> Iterator[None]:
    """Let the modules of these names that are imported in the context run when they are first used."""
    finder = _Later(names)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


with running_later(LATER):
    import mani_skill.envs  # noqa: F401
