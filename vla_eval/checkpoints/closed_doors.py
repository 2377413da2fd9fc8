"""The functions that import code, unpickle, or open more than data: they refuse while files are read."""

import contextlib
import functools
import importlib
import sys
import types
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, NoReturn  # transformers, diffusers, peft and torch's loaders are untyped

from vla_eval.errors import CheckpointError

Guard = Callable[..., Any]
"""Is called with the original function and its arguments in its place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """A function or `Class.method` and its guard; replaced in every module that has imported it."""

    module: str
    name: str
    guard: Guard


_open: dict[int, list[CheckpointError]] = {}
"""For each context that is open, of whatever thread, what was refused within it."""
_let_through: ContextVar[bool] = ContextVar("_let_through", default=False)
_replaced: set[tuple[str, str]] = set()


def replace(doors: tuple[Door, ...]) -> None:
    """Put the guards in their places; those that are there stay."""
    new = [door for door in doors if (door.module, door.name) not in _replaced]
    guarded: dict[int, Any] = {}
    for door in new:
        owner: Any = importlib.import_module(door.module)
        *inside, name = door.name.split(".")
        for part in inside:
            owner = getattr(owner, part)
        original = vars(owner)[name]
        if isinstance(original, classmethod):
            setattr(owner, name, classmethod(_guarded(original.__func__, door.guard)))
        else:
            guarded[id(original)] = _guarded(original, door.guard)
            setattr(owner, name, guarded[id(original)])
        _replaced.add((door.module, door.name))
    if guarded:
        # What was imported by `from … import`, under whatever name. A later import gets the guard.
        for module in list(sys.modules.values()):
            names = getattr(module, "__dict__", None)
            if not isinstance(names, dict):
                continue
            found = [name for name, value in list(names.items()) if id(value) in guarded]
            for name in found:
                names[name] = guarded[id(names[name])]


def _guarded(original: Any, guard: Guard) -> Any:
    @functools.wraps(original)
    def function(*args: Any, **kwargs: Any) -> Any:
        if not _open or _let_through.get():
            return original(*args, **kwargs)
        return guard(original, *args, **kwargs)

    return function


@contextlib.contextmanager
def closed() -> Iterator[None]:
    """Close the doors in the context; raise what was refused, also where a library continued."""
    refused: list[CheckpointError] = []
    _open[id(refused)] = refused
    try:
        yield
    except Exception as exc:
        if refused and exc is not refused[0]:
            raise refused[0] from exc
        raise
    finally:
        del _open[id(refused)]
    if refused:
        raise refused[0]


def refuse(message: str) -> NoReturn:
    """Raise an error that is not forgotten if somebody catches it."""
    error = CheckpointError(message)
    for refused in list(_open.values()):
        refused.append(error)
    raise error


@contextlib.contextmanager
def let_through() -> Iterator[None]:
    """Open the doors again within the context, for this thread alone and for files of no checkpoint."""
    token = _let_through.set(True)
    try:
        yield
    finally:
        _let_through.reset(token)


def functions_of(module: str) -> list[str]:
    """Return the names of the functions that a module defines."""
    loaded = importlib.import_module(module)
    return [
        name
        for name, value in vars(loaded).items()
        if isinstance(value, types.FunctionType) and value.__module__ == module
    ]
