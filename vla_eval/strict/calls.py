"""Calls of public functions: an argument too many, or of another type, is an error of this package."""

import functools
import inspect
import os
import types
from collections.abc import Callable, Iterator, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from vla_eval.errors import RecipeError

LIKE: dict[Any, Any] = {Path: os.PathLike, int: Integral, float: Real}  # Any: types


def public[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Compare the arguments of each call with the signature; `RecipeError` instead of Python's `TypeError`.

    The elements of lists are checked where they are read.
    """
    signature, name = inspect.signature(function), function.__qualname__

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as exc:
            raise RecipeError(f"{name}: {exc}. Expected {name}({', '.join(_shown(signature))}).") from exc
        for argument, value in given.items():
            parameter = signature.parameters[argument]
            for one in value if parameter.kind is parameter.VAR_POSITIONAL else (value,):
                if parameter.kind is not parameter.VAR_KEYWORD and not _fits(parameter.annotation, one):
                    expected = inspect.formatannotation(parameter.annotation).replace("pathlib.", "")
                    raise RecipeError(f"{name}: {argument}: expected {expected}, found {one!r:.80}.")
        return function(*args, **kwargs)

    return checked


def _shown(signature: inspect.Signature) -> Iterator[str]:
    """Yield the arguments that a call can have, those that have to be named with `=`."""
    for name, parameter in signature.parameters.items():
        yield f"{name}=…" if parameter.kind is parameter.KEYWORD_ONLY else str(parameter).split(":")[0]


def _fits(hint: Any, value: object) -> bool:  # Any: a type annotation
    if get_origin(hint) in (Union, types.UnionType):
        return any(_fits(option, value) for option in get_args(hint))
    if hint in (Any, inspect.Parameter.empty):
        return True
    if get_origin(hint) is Literal:  # which of them is checked where it is used
        return isinstance(value, str)
    if get_origin(hint):  # several
        return (isinstance(value, Sequence) and not isinstance(value, str)) or hasattr(value, "tolist")
    return isinstance(value, LIKE.get(hint, hint)) and (hint is bool or not isinstance(value, bool))
