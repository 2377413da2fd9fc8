"""`mikasa-vla list`: which tasks, families of tasks, policies, configs, prompts, datasets there are."""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import Folder, list_recipes, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.prompts import instruction_for, load_prompts
from vla_eval.errors import RecipeError
from vla_eval.evaluation.grid import ModelTable, is_model_table
from vla_eval.policies.registry import policy_adapters
from vla_eval.tasks.catalog import FAMILIES, TASKS

Row = Sequence[str]
RecipeClass = type[PolicyRecipe] | type[EvalConfig] | type[ModelTable] | type[DatasetRecipe]


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:
    """Declare the arguments."""
    parser = subparsers.add_parser(
        "list", help="list tasks, families, policies, configs, prompts, datasets", allow_abbrev=False
    )
    parser.add_argument("kind", nargs="?", choices=tuple(_LISTS), help="only these (default: all)")


def run(args: argparse.Namespace) -> int:
    """Print the lists."""
    kinds = [args.kind] if args.kind else list(_LISTS)
    for kind in kinds:
        if len(kinds) > 1:
            print(f"{kind}:")
        for line in _aligned(_LISTS[kind]()):
            print(f"  {line}" if len(kinds) > 1 else line)
    return 0


def _aligned(rows: Sequence[Row]) -> list[str]:
    """Return lines whose columns stand below each other; the last column is not padded."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _tasks() -> list[Row]:
    return [
        (
            spec.id,
            f"{spec.horizon_steps} steps",
            f"{spec.memory} memory",
            f"chance {_chance(spec.chance_success)}",
            f"“{instruction_for(spec)}”",
        )
        for spec in TASKS.values()
    ]


def _families() -> list[Row]:
    rows: list[Row] = []
    for spec in FAMILIES.values():
        needed = ", ".join(f"env.{name}" for name in spec.open_arguments)
        rows.append((spec.id, f"needs {needed}" if needed else "needs no argument"))
    return rows


def _chance(chance: float | None) -> str:
    return "measured" if chance is None else f"{chance:.2g}"


def _policies() -> list[Row]:
    rows = _recipes("policies", lambda _name: PolicyRecipe)
    adapters = [name for name in policy_adapters() if name not in {row[0] for row in rows}]
    return [*rows, *((name, "adapter without a recipe of its own") for name in adapters)]


def _configs() -> list[Row]:
    return _recipes("configs", lambda name: ModelTable if is_model_table(name) else EvalConfig)


def _prompts() -> list[Row]:
    return [(name, load_prompts(name).value.description) for name in list_recipes("prompts")]


def _datasets() -> list[Row]:
    return _recipes("datasets", lambda _name: DatasetRecipe)


def _recipes(folder: Folder, class_of: Callable[[str], RecipeClass]) -> list[Row]:
    rows: list[Row] = []
    for name in list_recipes(folder):
        try:
            rows.append((name, load_recipe(folder, name, class_of(name)).value.description))
        except RecipeError as exc:  # one broken file of the user's must not hide the others
            rows.append((name, f"CANNOT BE READ: {exc}"))
    return rows


_LISTS: dict[str, Callable[[], list[Row]]] = {
    "tasks": _tasks,
    "families": _families,
    "policies": _policies,
    "configs": _configs,
    "prompts": _prompts,
    "datasets": _datasets,
}
