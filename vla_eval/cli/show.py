"""`mikasa-vla show TASK`: what a task asks for, how it is scored, which arguments it takes."""

import argparse
import textwrap
from typing import Any

from vla_eval.config.prompts import DEFAULT_PROMPT_SET, instruction_for
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.source import TaskArgument, task_arguments
from vla_eval.tasks.spec import PhaseSource, TaskSpec

WIDTH = 100
INDENT = 14
OFFICIAL_PHASES: dict[PhaseSource, str] = {
    "cue_and_delay": "cue, delay, response; lengths as the package has or draws them",
    "cue": "cue, response; lengths as the package has or draws them",
    "none": "— (not to be read from the environment)",
}


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:
    """Declare the arguments."""
    parser = subparsers.add_parser("show", help="explain one task", allow_abbrev=False)
    parser.add_argument("task", metavar="TASK", help="task id (`mikasa-vla list tasks`)")
    parser.add_argument(
        "--prompt-set", default=DEFAULT_PROMPT_SET, metavar="NAME", help="which instructions (paper)"
    )


def run(args: argparse.Namespace) -> int:
    """Explain the task, without starting a simulator."""
    spec = task_spec(args.task)
    if spec.is_official:
        return _show_official(spec, args.prompt_set)
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
    for argument in arguments.values():
        default = spec.kwargs.get(argument.name, argument.default)
        if argument.name in spec.open_arguments:
            default = "… (must be given)"
        print(f"{'':{INDENT}}{argument.name} = {default}  ({argument.origin})")
    return 0


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


def _print(label: str, text: str) -> None:
    print(textwrap.fill(text, WIDTH, initial_indent=f"{label:{INDENT}}", subsequent_indent=" " * INDENT))


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
