"""`mikasa-vla list`: tasks, families, robots, policies, configs, prompts, datasets and protocols."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import get_args

from vla_eval.base_tasks.catalog import base_task
from vla_eval.checkpoints.bases import FIRST_TRAININGS
from vla_eval.cli.shared.config_kinds import config_class
from vla_eval.cli.terminal.screen import NARROWEST, filled, screen_width
from vla_eval.config.agents import AgentTable
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import Folder, list_recipes, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.prompts import PromptRecipe, instruction_for
from vla_eval.config.protocol import Protocol
from vla_eval.errors import PluginError, RecipeError, VlaEvalError
from vla_eval.evaluation.model_table import ModelTable
from vla_eval.policies.registry import policy_adapters
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.robots.find import robots
from vla_eval.robots.rows import ROWS
from vla_eval.tasks.catalog import FAMILIES, SUITES, installed_tasks
from vla_eval.tasks.spec import MemoryType, Suite, TaskSpec

Row = Sequence[str]
Groups = Mapping[str, Sequence[Row]]
"""Heading -> rows; a list without groups has one, without a heading."""
UNGROUPED, BROKEN, OF_PACKAGES = "", "cannot be read", "of other packages"
THINGS = "with everyday things"  # own tasks beyond the paper's table
BASELINES = "baselines and controls"
READY, TO_TRAIN, FROM_BASE = (
    "ready to evaluate",
    "to fine-tune, from scratch",
    "to fine-tune, from a published base",
)
REMOTE = "behind a socket: needs a server"
FOR_TESTS, ADAPTERS = "for tests: tiny, with random weights", "adapters without a recipe of their own"
TINY_SUFFIX = "_tiny"  # of the names of recipes for tests
RecipeClass = type[EvalConfig | ModelTable | AgentTable | DatasetRecipe | Protocol | PromptRecipe]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("kind", nargs="?", choices=tuple(_LISTS), help="only these (default: all)")
    parser.add_argument(
        "--suite",
        choices=tuple(SUITES),
        default="paper",
        help="which tasks: this package's (paper), the official package's 90 or original ones, MIKASA-Base",
    )
    parser.add_argument(
        "--memory",
        choices=get_args(MemoryType),
        metavar="TYPE",
        help="only tasks that need this type of memory: object, spatial, sequential, capacity …",
    )


def run(args: argparse.Namespace) -> int:
    """Print the lists."""
    kinds = [args.kind] if args.kind else list(_LISTS)
    for kind in kinds:
        if len(kinds) > 1:
            print(f"{kind}:")
        groups = _tasks(args.suite, args.memory) if kind == "tasks" else _LISTS[kind]()
        print_rows(groups, indent="  " if len(kinds) > 1 else "")
    return 0


def print_rows(groups: Groups, *, indent: str = "") -> None:
    """Print headings and rows, with the same columns in all groups; a terminal folds the last column."""
    rows = [row for group in groups.values() for row in group]
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    for heading, group in groups.items():
        if heading and group:
            print(f"{indent}{heading}:")
        for row in group:
            cells = [cell.ljust(width) for cell, width in zip(row[:-1], widths[:-1], strict=True)]
            margin, last = f"{indent}  " if heading else indent, row[-1]
            first, screen = f"{margin}{'  '.join(cells)}", screen_width(widest=None)
            if screen is None or len(first) + len("  ") + len(last) <= screen or not last:
                print(f"{first}  {last}".rstrip())
            elif screen - len(first) >= NARROWEST:
                print(filled(last, screen, first=f"{first}  ", rest=" " * (len(first) + len("  "))))
            else:
                print(first.rstrip())
                print(filled(last, screen, first=f"{margin}    ", rest=f"{margin}    "))


def _tasks(suite: Suite = "paper", memory: MemoryType | None = None) -> Groups:
    groups: dict[str, list[Row]] = {}
    for spec in SUITES[suite].values():
        if memory not in (None, *spec.memory_types):
            continue
        groups.setdefault(spec.split or UNGROUPED, []).append(_task(spec))
    if suite == "paper":
        things = SUITES["objects"].values()
        groups[THINGS] = [_task(one) for one in things if memory in (None, *one.memory_types)]
        try:
            groups[OF_PACKAGES] = [_task(spec) for spec in installed_tasks().values()]
        except PluginError as exc:
            groups[BROKEN] = [(OF_PACKAGES, "", "", "", _broken("", exc)[-1])]
    return groups


def _task(spec: TaskSpec) -> Row:
    cells = (spec.id, f"{spec.horizon_steps} steps", f"{', '.join(spec.memory_types)} memory")
    if spec.is_base:
        return (*cells, base_task(spec.id).tier, spec.description)
    known = "measured" if spec.chance_success is None else f"{spec.chance_success:.2g}"
    chance = () if spec.split else (f"chance {known}",)
    return (*cells, *chance, f"“{instruction_for(spec)}”")


def _robots() -> Groups:
    broken = []
    try:
        arms = tuple(robots().values())
    except PluginError as exc:
        arms, broken = ROWS, [(OF_PACKAGES, "", _broken("", exc)[-1])]
    rows = [(arm.name, ", ".join(arm.actions), arm.description) for arm in arms]
    return {UNGROUPED: rows, BROKEN: broken}


def _families() -> Groups:
    rows: list[Row] = []
    for spec in FAMILIES.values():
        needed = ", ".join(f"env.{name}" for name in spec.open_arguments)
        rows.append((spec.id, f"needs {needed}" if needed else "needs no argument"))
    return {UNGROUPED: rows}


def _policies() -> Groups:
    groups: dict[str, list[Row]] = {
        heading: []
        for heading in (BASELINES, READY, TO_TRAIN, FROM_BASE, REMOTE, FOR_TESTS, ADAPTERS, BROKEN)
    }
    recipes = list_recipes("policies")
    for name in recipes:
        try:
            recipe = load_recipe("policies", name, PolicyRecipe).value
        except RecipeError as exc:
            groups[BROKEN].append(_broken(name, exc))
        else:
            groups[_group(name, recipe)].append((name, recipe.description))
    groups[ADAPTERS] = [(name, "") for name in policy_adapters() if name not in recipes]
    return groups


def _group(name: str, recipe: PolicyRecipe) -> str:
    """Return the heading that a policy is listed under: what has to be done before it is evaluated."""
    if recipe.adapter == REMOTE_ADAPTER:
        return REMOTE
    if recipe.finetune is None:
        return READY if "checkpoint" in recipe.args else BASELINES
    if name.endswith(TINY_SUFFIX):
        return FOR_TESTS
    base = recipe.finetune.base_checkpoint
    return TO_TRAIN if base is None or Path(base).name in FIRST_TRAININGS else FROM_BASE


def _recipes(folder: Folder, class_of: Callable[[str], RecipeClass]) -> Groups:
    rows: list[Row] = []
    for name in list_recipes(folder):
        try:
            rows.append((name, load_recipe(folder, name, class_of(name)).value.description))
        except RecipeError as exc:
            rows.append(_broken(name, exc))
    return {UNGROUPED: rows}


def _broken(name: str, exc: VlaEvalError) -> Row:
    """Return a line for a file that cannot be read: it must not hide the others."""
    return (name, f"CANNOT BE READ: {exc}")


_LISTS: dict[str, Callable[[], Groups]] = {
    "tasks": _tasks,
    "families": _families,
    "robots": _robots,
    "policies": _policies,
    "configs": lambda: _recipes("configs", config_class),
    "prompts": lambda: _recipes("prompts", lambda _name: PromptRecipe),
    "datasets": lambda: _recipes("datasets", lambda _name: DatasetRecipe),
    "protocols": lambda: _recipes("protocols", lambda _name: Protocol),
}
