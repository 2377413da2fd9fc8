"""What the class of a task says in its source: its arguments and constants.

The source is read, not imported: importing it would start a simulator.
"""

import ast
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import NamedTuple

SIMULATOR = "mani_skill"  # to look for one of its modules would import it
# Chosen by other options (the robot by one of every task), or not at all.
NOT_FOR_USERS = ("instruction", "reconfiguration_freq", "robot_uids")


class TaskArgument(NamedTuple):
    """One keyword argument of a task's class; default and annotation as in its source."""

    name: str
    default: str
    annotation: str
    origin: str  # the class that takes it


@cache
def task_arguments(entry_point: str) -> tuple[TaskArgument, ...]:
    """Return the keyword arguments of a task's class, `module:Class`, and of its bases, nearest first.

    What a class itself gives to its base is not one of them. Empty if the class has no source to read.
    """
    found: list[TaskArgument] = []
    seen = set(NOT_FOR_USERS)
    for module, node in _classes(*entry_point.split(":")):
        for init in node.body:
            if not isinstance(init, ast.FunctionDef) or init.name != "__init__":
                continue
            for argument, default in zip(init.args.kwonlyargs, init.args.kw_defaults, strict=True):
                if argument.arg in seen or default is None:
                    continue
                annotation = ast.unparse(argument.annotation) if argument.annotation else "Any"
                found.append(TaskArgument(argument.arg, _value(module, default), annotation, node.name))
            seen.update(argument.name for argument in found)
            calls = (call for call in ast.walk(init) if isinstance(call, ast.Call))
            to_base = (call for call in calls if ast.unparse(call.func) == "super().__init__")
            seen.update(keyword.arg for call in to_base for keyword in call.keywords if keyword.arg)
    return tuple(found)


def class_constant(entry_point: str, name: str) -> object:
    """Return a literal that a task's class or its nearest base has under this name; None if none has."""
    for _, node in _classes(*entry_point.split(":")):
        for line in node.body:
            targets = line.targets if isinstance(line, ast.Assign) else [getattr(line, "target", None)]
            if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                value = getattr(line, "value", None)
                return None if value is None else ast.literal_eval(value)
    return None


class _Module(NamedTuple):
    """What a module says."""

    body: Sequence[ast.stmt]
    imported: dict[str, tuple[str, str]]  # name here -> module, name there


@cache
def _module(name: str) -> _Module:
    found = None if name.partition(".")[0] == SIMULATOR else find_spec(name)
    if found is None or found.origin is None or not found.origin.endswith(".py"):
        return _Module([], {})
    tree = ast.parse(Path(found.origin).read_text(encoding="utf-8"))
    for node in ast.walk(tree):  # functions are not asked for, and what is kept slows each search for garbage
        if isinstance(node, ast.Module | ast.ClassDef):
            node.body = [
                part for part in node.body if not isinstance(part, ast.FunctionDef) or part.name == "__init__"
            ]
    package = name if found.submodule_search_locations else name.rpartition(".")[0]
    imported = {
        alias.asname or alias.name: (
            resolve_name("." * node.level + (node.module or ""), package),
            alias.name,
        )
        for node in _outside_of_definitions(tree.body)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    return _Module(tree.body, imported)


def _outside_of_definitions(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    for node in nodes:
        yield node
        if isinstance(node, ast.If | ast.Try | ast.ExceptHandler | ast.With):
            yield from _outside_of_definitions(ast.iter_child_nodes(node))


def _classes(module_name: str, class_name: str) -> Iterator[tuple[str, ast.ClassDef]]:
    """Yield a class and its bases below ManiSkill's, each with its module's name, from their source."""
    module = _module(module_name)
    if class_name in module.imported:
        yield from _classes(*module.imported[class_name])
    for node in module.body:
        if not isinstance(node, ast.ClassDef) or node.name != class_name:
            continue
        yield module_name, node
        for base in node.bases:
            yield from _classes(module_name, ast.unparse(base))


def _value(module_name: str, expression: ast.expr) -> str:
    """Return an expression's text; for the name of a constant that of its value."""
    if not isinstance(expression, ast.Name):
        return ast.unparse(expression)
    name, module = expression.id, _module(module_name)
    if name in module.imported:
        other, name = module.imported[name]
        return _value(other, ast.Name(name))
    for node in module.body:
        if isinstance(node, ast.Assign) and name in (ast.unparse(target) for target in node.targets):
            return _value(module_name, node.value)
    return name
