"""Find the code behind a name: policy adapters, ours and other people's.

A name is looked up among ours, then among installed packages that declare the entry point group
`vla_eval.policies`; a name with a colon is `module:attr`. Nothing is imported before it is asked for.

A module named in a recipe is trusted: it is imported. A recipe from elsewhere must
not reach Python's own functions that way, so modules of the standard library and `__main__` hold no adapter;
and what is found is called only if it is a function or a class that takes a context.
"""

import functools
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any

from vla_eval.core import Policy
from vla_eval.errors import (
    MAX_SHOWN,
    MissingDependencyError,
    RecipeError,
    UnknownNameError,
    did_you_mean,
    unknown_name,
)
from vla_eval.lock.switch import let_everything
from vla_eval.models.families import FAMILIES
from vla_eval.policies.context import PolicyContext
from vla_eval.seeding import seed_global_generators

PolicyFactory = Callable[..., Policy]
"""`make_x(context: PolicyContext, **args) -> Policy`; `args` come from the policy's recipe."""

POLICY_GROUP = "vla_eval.policies"

POLICIES = {
    "random": "vla_eval.policies.controls.scripted:make_random",
    "hold": "vla_eval.policies.controls.scripted:make_hold",
    "oracle": "vla_eval.policies.controls.scripted:make_oracle",
    "cue_blind": "vla_eval.policies.controls.scripted:make_cue_blind",
    "tour": "vla_eval.policies.controls.scripted:make_tour",
    "cue_reader": "vla_eval.policies.controls.scripted:make_cue_reader",
    "body_memory": "vla_eval.policies.controls.shortcuts:make_body_memory",
    "cue_touch": "vla_eval.policies.controls.shortcuts:make_cue_touch",
    "one_frame": "vla_eval.policies.controls.shortcuts:make_one_frame",
    "memoryless": "vla_eval.policies.controls.base_players:make_memoryless",
    "lerobot": "vla_eval.policies.lerobot.policy:make_lerobot",
    "remote": "vla_eval.policies.remote.policy:make_remote",
    **{name: target for family in FAMILIES.values() for name, target in family.adapters.items()},
}
_SCRIPTED_MODULES = ("vla_eval.policies.controls.",)
SCRIPTED = frozenset(name for name, target in POLICIES.items() if target.startswith(_SCRIPTED_MODULES))
"""Those of ours that read no image."""
PRIVILEGED = frozenset({"oracle", "cue_blind", "tour", "cue_reader", "body_memory", "cue_touch", "one_frame"})
"""Those of ours that read the true state of the world."""


_TARGET = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
_NO_ADAPTERS = frozenset({*sys.stdlib_module_names, *sys.builtin_module_names, "__main__"})
_OWN_ADAPTERS = ("vla_eval.policies.", "vla_eval.testing.")  # the rest of this package holds none


def policy_adapters() -> dict[str, str]:
    """Return name -> `module:attr` of all adapters; ours win over another package's of the same name."""
    others: dict[str, str] = {point.name: point.value for point in entry_points(group=POLICY_GROUP)}
    return {**others, **POLICIES}


def check_adapter(adapter: str) -> None:
    """Raise what `policy_factory` would raise for a mistyped name, without importing the adapter."""
    module_name, _ = _target(adapter)
    root = module_name.partition(".")[0]
    if root not in sys.modules and find_spec(root) is None:
        raise _no_module(adapter, module_name)


def own_modules(adapters: Iterable[str]) -> tuple[str, ...]:
    """Return the modules of those adapters that come with this package."""
    modules = (_target(adapter)[0] for adapter in adapters)
    return tuple(dict.fromkeys(name for name in modules if name.startswith("vla_eval.")))


def policy_factory(adapter: str) -> PolicyFactory:
    """Return the function that makes policies of this adapter.

    Raises:
        UnknownNameError: there is no such adapter, module or attribute.
        MissingDependencyError: the adapter's module needs a package that is not installed.
    """
    module_name, attribute = _target(adapter)
    if not module_name.startswith(_OWN_ADAPTERS):
        let_everything(f"{adapter} is a policy of the user's own")
    try:
        found: Any = importlib.import_module(module_name)  # Any: whatever the module holds
    except ModuleNotFoundError as exc:
        if exc.name and (module_name == exc.name or module_name.startswith(f"{exc.name}.")):
            raise _no_module(adapter, module_name) from exc
        raise MissingDependencyError(
            f"policy adapter '{adapter}' needs the package '{exc.name}', which is not installed. "
            f"Install what {module_name} needs; `mikasa-vla doctor` lists the extras of this package."
        ) from exc
    for part in attribute.split("."):
        if not hasattr(found, part):
            known = [name for name in dir(found) if not name.startswith("_")]
            raise UnknownNameError(
                f"policy adapter '{adapter}': {module_name} has no '{attribute}'.{did_you_mean(part, known)}"
            )
        found = getattr(found, part)
    if not takes_a_context(found):
        raise UnknownNameError(
            f"policy adapter '{adapter}': {found!r:.60} is not a function that makes a policy, nor a class "
            f"of policies: expected `make(context, **args)`."
        )
    factory: PolicyFactory = found
    return factory


def make_from_adapter(adapter: str, context: PolicyContext, args: Mapping[str, Any]) -> Policy:
    """Make a policy of an adapter with a recipe's arguments, global generators seeded by its name.

    Raises:
        RecipeError: the adapter does not take these arguments. Else see `policy_factory`.
    """
    factory = policy_factory(adapter)
    seed_global_generators("policy", context.name)
    try:
        inspect.signature(factory).bind(context, **args)
    except TypeError as exc:
        raise RecipeError(
            f"policy '{context.name}': the adapter '{adapter}' does not take the recipe's args "
            f"{dict(args)}: {exc}. It is called as {adapter}{inspect.signature(factory)}."
        ) from exc
    return factory(context, **args)


def _target(adapter: str) -> tuple[str, str]:
    # Ours first: to look through the installed packages takes 10 ms, several times per evaluation.
    target = adapter if ":" in adapter else POLICIES.get(adapter) or policy_adapters().get(adapter)
    if target is None:
        raise unknown_name("policy adapter", adapter, policy_adapters())
    if not _TARGET.fullmatch(target):
        raise UnknownNameError(
            f"policy adapter '{adapter:.{MAX_SHOWN}}': expected 'module:attribute', for example "
            f"'my_pkg.policy:make'."
        )
    module_name, _, attribute = target.partition(":")
    root = module_name.partition(".")[0]
    if root in _NO_ADAPTERS or (root == "vla_eval" and not module_name.startswith(_OWN_ADAPTERS)):
        owner = "this package" if root == "vla_eval" else "Python itself"
        raise UnknownNameError(
            f"policy adapter '{adapter}': {module_name} is a module of {owner} and holds no policies. "
            f"Name a module of yours, for example 'my_pkg.policy:make'."
        )
    return module_name, attribute


def takes_a_context(found: Any) -> bool:  # Any: whatever the module holds
    """Whether this is a function or a class that can be given a context as its first argument."""
    if not (inspect.isroutine(found) or inspect.isclass(found) or isinstance(found, functools.partial)):
        return False
    try:
        parameters = inspect.signature(found).parameters.values()
    except (ValueError, TypeError):  # code in C that does not say what it takes
        return False
    positional = (
        inspect.Parameter.POSITIONAL_ONLY,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        inspect.Parameter.VAR_POSITIONAL,
    )
    return any(parameter.kind in positional for parameter in parameters)


def _no_module(adapter: str, module_name: str) -> UnknownNameError:
    return UnknownNameError(
        f"policy adapter '{adapter}': there is no module '{module_name}'. Install the package that holds it, "
        f"or put its folder on PYTHONPATH."
    )
