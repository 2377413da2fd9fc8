"""Policies that are Python objects; workers get a copy by cloudpickle. Nothing from a file gets here."""

import functools
import hashlib
import inspect
import io
import pickle
import re
import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # whatever the user gives, and what it consists of

import cloudpickle

from vla_eval.config.files import Recipe, check_recorded_name, list_recipes
from vla_eval.config.policy import PolicyRecipe
from vla_eval.core import Policy
from vla_eval.errors import RecipeError
from vla_eval.lock.switch import let_everything
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.entries import PolicyEntry
from vla_eval.policies.recipe import BIG_CHECKPOINT_BYTES
from vla_eval.policies.registry import takes_a_context
from vla_eval.workers.messages import INSTALLED

ADAPTER = "vla_eval.policies.given:make_given"
MEMBERS = ("spec", "reset", "act")
_CLASS_ID = re.compile("[0-9a-f]{32}")  # cloudpickle draws one for each class of a notebook


@dataclass(frozen=True, slots=True, kw_only=True)
class GivenPolicy:
    """What makes a policy, pickled: the argument of this adapter."""

    pickled: bytes


def make_given(context: PolicyContext, *, given: GivenPolicy) -> Policy:
    """Make the policy, or return the copy of the instance; the adapter of `given_entry`."""
    if not isinstance(given, GivenPolicy):
        raise RecipeError(f"{ADAPTER} is for objects that Python code gives; no recipe can name one.")
    let_everything(f"{context.name} is a policy of the user's own")
    try:
        found = pickle.loads(given.pickled)
    except ImportError as exc:
        raise RecipeError(
            f"policy '{context.name}': a worker cannot import what it is made of ({exc}). Install that "
            f"package, put its folder on PYTHONPATH, or define the policy in the script or notebook itself."
        ) from exc
    if _is_instance(found):
        return found  # type: ignore[no-any-return]
    made = found(context) if takes_a_context(found) else found()
    if not _is_instance(made):
        raise _not_a_policy(context.name, made)
    return made  # type: ignore[no-any-return]


def given_entry(found: object, *, name: str | None = None) -> PolicyEntry:
    """Return an object, or a class or function that makes one from a context or nothing, as an entry."""
    name = name or _name_of(found)
    check_recorded_name(name, kind="policy")
    if name in list_recipes("policies"):  # tables know `oracle` and `cue_blind` by their names
        raise RecipeError(
            f"policy '{name}': policies/ has a recipe of this name. Give another: policy={{'my_{name}': …}}"
        )
    try:
        pickled = _dumped(found, _Copier)
    except Exception as exc:  # whatever the objects in it raise
        raise RecipeError(
            f"policy '{name}': expected an object that can be copied to worker processes, found one that "
            f"cannot ({type(exc).__name__}: {exc}). Give the class, or a function that makes the policy."
        ) from exc
    recipe = PolicyRecipe(
        version=1,
        description="A policy of Python code.",
        adapter=ADAPTER,
        args={"given": GivenPolicy(pickled=pickled)},
        max_workers=1 if len(pickled) >= BIG_CHECKPOINT_BYTES else None,
    )
    identity = Recipe(name=name, path=Path(), sha256=identity_of(found), value=recipe)
    return PolicyEntry(name=name, recipes=(identity,), texts=(name,))


def identity_of(found: object) -> str:
    """Return the sha256 of an object's code, values and modules; another only starts a new run."""
    digest = hashlib.sha256(_dumped(found, _Describer))
    of_class = found if inspect.isclass(found) else type(found)
    modules = {one.__module__ for one in of_class.__mro__} | {getattr(found, "__module__", "")}
    for module in sorted(modules - {"__main__"}):
        path = getattr(sys.modules.get(module), "__file__", None)
        if path is not None and not path.startswith(INSTALLED):
            digest.update(Path(path).read_bytes())
    return digest.hexdigest()


class _Copier(cloudpickle.Pickler):  # type: ignore[misc]  # cloudpickle is untyped
    """Pickles a class of a notebook without its id, by which a copy overwrites the original."""

    def reducer_override(self, obj: Any) -> Any:
        """Return how an object is pickled."""
        reduced = super().reducer_override(obj)
        if isinstance(obj, type) and isinstance(reduced, tuple):
            args = (None if isinstance(one, str) and _CLASS_ID.fullmatch(one) else one for one in reduced[1])
            reduced = (reduced[0], tuple(args), *reduced[2:])
        return reduced


class _Describer(_Copier):
    """Pickles an object for its digest alone: without line numbers and file names, which cells change."""

    def reducer_override(self, obj: Any) -> Any:
        """Return how an object is pickled."""
        return (tuple, (_facts(obj),)) if isinstance(obj, types.CodeType) else super().reducer_override(obj)


def _dumped(found: object, pickler: type[_Copier]) -> bytes:
    buffer = io.BytesIO()
    pickler(buffer).dump(found)
    return buffer.getvalue()


def _facts(code: types.CodeType) -> tuple[Any, ...]:
    constants = (_facts(one) if isinstance(one, types.CodeType) else _constant(one) for one in code.co_consts)
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return (code.co_code, *names, code.co_flags, tuple(constants))


def _constant(value: object) -> str:
    """Return a constant as text: a set's order differs between processes."""
    return repr(sorted(map(repr, value))) if isinstance(value, frozenset) else repr(value)


def _is_instance(found: object) -> bool:
    return not inspect.isclass(found) and all(hasattr(found, name) for name in MEMBERS)


def _name_of(found: object) -> str:
    if _is_instance(found):
        return str(found.spec.name)  # type: ignore[attr-defined]
    if not (inspect.isclass(found) or inspect.isroutine(found) or isinstance(found, functools.partial)):
        raise _not_a_policy("policy", found)
    named = found.func if isinstance(found, functools.partial) else found
    if named.__name__ == "<lambda>":
        raise RecipeError('policy: a lambda has no name. Give it one: policy={"mine": lambda context: …}')
    return str(named.__name__)


def _not_a_policy(name: str, found: object) -> RecipeError:
    missing = ", ".join(member for member in MEMBERS if not hasattr(found, member))
    return RecipeError(
        f"{name}: expected a policy (an object with spec, reset and act), a class or function that makes "
        f"one, or a name as for --policy; found {found!r:.100}, which has no {missing}."
    )
