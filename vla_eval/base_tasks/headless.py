"""Drawing by MuJoCo without a screen: which library does it, and what to install where none is."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

from vla_eval.errors import MissingDependencyError, RenderingError

RENDERERS = (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8"))
"""Values of MUJOCO_GL that need no screen, and the library of each."""
INSTALL = (
    "Install EGL (in a clone by `make base`; Debian, Ubuntu: apt-get install libegl1 libopengl0 "
    "libgl1-mesa-dri), or OSMesa (libosmesa6)."
)


def not_started(exc: Exception) -> RenderingError:
    """Return the error for a renderer that is there but does not start."""
    setting = os.environ.get("MUJOCO_GL")
    return RenderingError(
        f"The renderer does not start (MUJOCO_GL={setting}): {exc}. Unset MUJOCO_GL. {INSTALL}"
    )


@contextmanager
def renderer_chosen() -> Iterator[None]:
    """Set MUJOCO_GL, unless the user has; Mesa draws in this thread, so that it works after a fork."""
    if not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = available_renderer()
    was_set = "LP_NUM_THREADS" in os.environ
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        yield
    finally:
        if not was_set:  # SAPIEN draws by the same library, with threads
            del os.environ["LP_NUM_THREADS"]


def available_renderer() -> str:
    """Return the value of MUJOCO_GL for the first library that is here.

    Raises:
        MissingDependencyError: there is none.
    """
    for name, library in RENDERERS:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return name
    libraries = " nor ".join(library for _, library in RENDERERS)
    raise MissingDependencyError(f"To draw without a screen: neither {libraries} is here. {INSTALL}")
