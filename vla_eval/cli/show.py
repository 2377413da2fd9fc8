"""`mikasa-vla show NAME`: a task, by its source, a recipe's fields, or what a folder is."""

import argparse
import os
import textwrap
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

from vla_eval.base_tasks.catalog import base_task
from vla_eval.base_tasks.row import NAMESPACE
from vla_eval.cli.shared.config_kinds import CONFIG_CLASSES, config_class
from vla_eval.cli.terminal.screen import filled
from vla_eval.config.agents import AgentTable
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import Folder, list_recipes, load_recipe, no_such_path, recipe_fields
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.prompts import DEFAULT_PROMPT_SET, instruction_for
from vla_eval.config.protocol import Protocol
from vla_eval.errors import RecipeError, some_of, unknown_name
from vla_eval.evaluation.model_table import ModelTable
from vla_eval.robots.find import robots
from vla_eval.robots.rows import PANDA
from vla_eval.tasks.catalog import FAMILIES, TASKS, family_of, find_task, installed_tasks, task_spec
from vla_eval.tasks.source import TaskArgument, task_arguments
from vla_eval.tasks.spec import PhaseSource, TaskSpec

WIDTH = 100
INDENT = 14
OFFICIAL_PHASES: dict[PhaseSource, str] = {
    "cue_and_delay": "cue, delay, response; lengths as the package has or draws them",
    "cue": "cue, response; lengths as the package has or draws them",
    "none": "— (not to be read from the environment)",
}


_RecipeClass = type[PolicyRecipe | EvalConfig | ModelTable | AgentTable | DatasetRecipe | Protocol]


class _Kind(NamedTuple):
    """Recipes of one folder: what one is called, what it is read as, and what is done with it."""

    word: str
    recipe: _RecipeClass
    next_step: str


KINDS: dict[Folder, _Kind] = {
    "policies": _Kind("policy", PolicyRecipe, "mikasa-vla check {name}"),
    "configs": _Kind("config", EvalConfig, "mikasa-vla eval {name}"),
    "datasets": _Kind("dataset", DatasetRecipe, "mikasa-vla record {name}"),
    "protocols": _Kind("protocol", Protocol, "mikasa-vla eval --protocol {name} --policy POLICY"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "name", metavar="NAME", help="task id, name or file of a recipe (`mikasa-vla list`), or a folder"
    )
    parser.add_argument(
        "--prompt-set", default=DEFAULT_PROMPT_SET, metavar="NAME", help="which instructions (paper)"
    )


def run(args: argparse.Namespace) -> int:
    """Explain what is named, without starting a simulator."""
    if find_task(args.name) is None and not args.name.startswith(NAMESPACE):
        return _show_folder(Path(args.name)) if os.path.isdir(args.name) else _show_recipes(args.name)
    spec = task_spec(args.name)
    if spec.is_official:
        return _show_official(spec, args.prompt_set)
    if spec.is_base:
        return _show_base(spec)
    _print("task", f"{spec.id} (rules version {spec.version}, {spec.memory} memory)")
    _print("asks", spec.description)
    _print("instruction", f"“{instruction_for(spec, args.prompt_set)}” (prompts/{args.prompt_set})")
    _print("success", spec.success)
    _print("chance", _chance(spec))
    _print("horizon", _horizon(spec))
    arguments = {argument.name: argument for argument in task_arguments(spec.entry_point)}
    _print("phases", _phases(spec, arguments))
    _print("oracle", spec.oracle)
    _print(
        "arguments",
        "set in a configuration's `env:`, or by --set env.NAME=VALUE; `docs/tasks.md` explains them",
    )
    print(f"{'':{INDENT}}horizon_steps = {spec.horizon_steps}  (every task)")
    print(f"{'':{INDENT}}robot = {PANDA.name!r}  (every task; {', '.join(_robots(spec))})")
    for argument in arguments.values():
        default = spec.kwargs.get(argument.name, argument.default)
        if argument.name in spec.open_arguments:
            default = "… (must be given)"
        print(f"{'':{INDENT}}{argument.name} = {default}  ({argument.origin})")
    return 0


def _robots(spec: TaskSpec) -> list[str]:
    """Return the names of the robots that solve a task."""
    return [arm.name for arm in robots().values() if family_of(spec) not in arm.not_solved]


def _show_folder(folder: Path) -> int:
    # Here and not above: tasks and recipes need not wait for what reads datasets.
    from vla_eval.cli.shared.folders import folder_lines

    for label, text in folder_lines(folder):
        _print_whole(label, text)
    return 0


def _show_recipes(name: str) -> int:
    """Print the recipes of a name; a file is what its folder is called, or what its fields are of."""
    stem = Path(name.removesuffix(".yaml")).name
    folder = Path(name).parent.name
    if os.path.isfile(name):
        of_folder = [kind for kind in KINDS if kind == folder]
        _show_recipe(of_folder[0] if of_folder else _kind_of_file(name), name)
        return 0
    kinds = [kind for kind in KINDS if folder in ("", kind)]
    found = [kind for kind in kinds if stem in list_recipes(kind)]
    if not found and os.sep in name and not kinds:
        raise no_such_path(name, "mikasa-vla list")
    if not found:
        known = [one for kind in KINDS for one in list_recipes(kind)]
        raise unknown_name(
            "task, policy, configuration, dataset, protocol or folder",
            name,
            {*TASKS, *FAMILIES, *installed_tasks(), *known},
        )
    for kind in found:
        _show_recipe(kind, stem if folder in ("", kind) else name)
    return 0


def _kind_of_file(name: str) -> Folder:
    """Return which kind of recipe has all the fields of a file."""
    given = recipe_fields("configs", name)
    for folder, kind in KINDS.items():
        for cls in (kind.recipe, *(CONFIG_CLASSES if folder == "configs" else ())):
            if given <= {field.name for field in fields(cls)}:
                return folder
    raise RecipeError(
        f"{name}: no kind of recipe has all of its fields ({some_of(sorted(given))}). Put it into a folder "
        f"of the name of its kind ({', '.join(KINDS)}) to see which one is wrong."
    )


def _show_recipe(folder: Folder, name: str) -> None:
    kind = KINDS[folder]
    cls: _RecipeClass = config_class(name) if folder == "configs" else kind.recipe
    recipe = load_recipe(folder, name, cls)
    next_step = kind.next_step
    if isinstance(recipe.value, PolicyRecipe) and recipe.value.finetune is not None:
        next_step = "mikasa-vla finetune --policy {name} --dataset DIR"
    elif cls is AgentTable:
        next_step = "mikasa-vla train-agent {name}"
    elif cls is ModelTable:
        next_step = "mikasa-vla finetune {name}, then mikasa-vla eval {name}"
    _print(kind.word, recipe.name)
    _print_whole("file", str(recipe.path))
    _print("about", recipe.value.description)
    _print("next", next_step.format(name=recipe.name))
    print(f"fields\n{textwrap.indent(recipe.path.read_text(encoding='utf-8').rstrip(), '  ')}")


def _show_official(spec: TaskSpec, prompt_set: str) -> int:
    """Explain a task of the official package, which need not be installed."""
    split = f", {spec.split} split" if spec.split else ""
    _print("task", f"{spec.id} (rules version {spec.version}, {spec.memory} memory{split})")
    _print("instruction", f"“{instruction_for(spec, prompt_set)}”")
    _print("success", spec.success)
    _print("horizon", _horizon(spec))
    _print("phases", OFFICIAL_PHASES[spec.phase_source])
    if spec.chance_success is not None:
        _print("chance", _chance(spec))
    _print("oracle", spec.oracle or spec.oracle_sees)
    if spec.waits_for_choice:
        _print("waits", "until the choice, every action is replaced by zeros")
    _print("arguments", "env.horizon_steps; env.mug = ycb or stand_in, in the shell games")
    _print("runs in", "the official package: `make suite90`, docs/official_suite.md")
    return 0


def _show_base(spec: TaskSpec) -> int:
    """Explain a task of MIKASA-Base, whose packages need not be installed."""
    row = base_task(spec.id)
    figures = row.figures
    _print("task", f"{row.gym_id} (rules version {row.version}, {', '.join(row.memory)} memory, {row.tier})")
    _print("asks", row.description)
    _print("remember", row.remember)
    _print("success", row.success or "no natural rule: its score is the return")
    _print("horizon", f"{row.horizon_steps} steps")
    known = {"random": figures.random, "memoryless": figures.memoryless, "best": figures.best}
    _print(
        "returns", ", ".join(f"{name} {'—' if one is None else f'{one:g}'}" for name, one in known.items())
    )
    _print("measured", figures.source)
    _print("rules", row.source)
    _print(
        "needs", f"`make base`, or the extra [{row.extra}]" if row.extra else "nothing more than this package"
    )
    _print_whole("next", f"mikasa-vla eval --task {row.gym_id} --policy random memoryless oracle")
    return 0


def _print_whole(label: str, text: str) -> None:
    """Print a path or a command on one line, so that it can be copied."""
    print(f"{label:{INDENT}}{text}")


def _print(label: str, text: str) -> None:
    print(filled(text, WIDTH, first=f"{label:{INDENT}}", rest=" " * INDENT))


def _chance(spec: TaskSpec) -> str:
    if spec.chance_success is not None:
        return f"{spec.chance_success:.3g} for a perfect arm that ignores the cue"
    if spec.candidates is not None:
        return "as the arguments say; each record has it"
    return "has to be measured: there is no choice among candidates"


def _horizon(spec: TaskSpec) -> str:
    fixed = f"{spec.horizon_steps} control steps at 20 Hz = {spec.horizon_steps / 20:g} s"
    if spec.min_response_steps is None:
        return fixed
    return f"{fixed}, or longer: at least {spec.min_response_steps} steps after cue and delay"


def _phases(spec: TaskSpec, arguments: dict[str, TaskArgument]) -> str:
    if spec.candidates is None:
        return "none: what matters is in view, but changes"
    lengths = [
        f"{name} {_in_turn(spec, name)}{arguments[f'{name}_steps'].default} steps"
        for name in ("cue", "delay")
        if f"{name}_steps" in arguments
    ]
    return ", then ".join([*lengths, f"response: choose among the {spec.candidates} until the horizon"])


def _in_turn(spec: TaskSpec, phase: str) -> str:
    """Return `3 × ` for a cue of three things one after another."""
    if phase != "cue" or not spec.shows_one_by_one:
        return ""
    return f"{spec.kwargs.get('n_shown', 'n_shown')} × "
