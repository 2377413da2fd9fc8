"""`mikasa-vla probe`: what a policy remembers, for how long, and whether it acts on it."""

import argparse
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.probe_grid import add_grid_arguments, run_grid
from vla_eval.cli.shared.arguments import (
    EXIT_EPISODE_ERRORS,
    add_allow_environment_change,
    add_json_progress,
    add_overrides,
    add_shard,
    workers_argument,
)
from vla_eval.cli.shared.cluster import add_cluster
from vla_eval.cli.shared.output import print_in
from vla_eval.cli.shared.probe_runs import run_all
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides, load_recipe
from vla_eval.errors import RecipeError, unknown_name
from vla_eval.results.formats import FORMATS
from vla_eval.strict.decoding import decode

if TYPE_CHECKING:
    from vla_eval.probe.grid import GridSettings
    from vla_eval.probe.worlds import ProbeSettings

DESCRIPTION = """Run each task as it is and with one thing changed, on the same seeds, and compare.

swap: another cue in the same scene. Who follows the cue chooses what was shown in each of the two worlds.
order: the same items in another order (Seq, Chain). shuffle: as order, with the right answer as before.
blank: the cue phase passes without a cue. freeze: the policy sees the cue's first frame throughout.
mask: part of the image is hidden. late: nothing is shown before the cue. cue, delay: other lengths of the
phase. delay_swap: a swap after each delay. distractor: another item is seen in the delay. interference: the
arm is moved in the delay. reset: the policy is reset in mid-episode. instruction: other sentences.
appearance: light, camera, colours.

With --grid, chunk lengths against the lengths of the phases: what of the cue falls into an inference?

CONFIG is a file, or the name of one in configs/; without it, name at least one --task and one --policy.
The controls oracle, cue_blind and body_memory are run beside the policies. The same command resumes."""
EPISODES = 50


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    parser = subparsers.add_parser(
        "probe",
        help="find out what a policy remembers, and for how long",
        description=DESCRIPTION,
        epilog="docs/probe.md defines each quantity.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("config", nargs="?", metavar="CONFIG", help="file, or name in configs/")
    many: dict[str, Any] = {"nargs": "+", "action": "extend"}  # Any: argparse's keyword arguments
    parser.add_argument("--task", **many, dest="tasks", metavar="T", help="task ids")
    parser.add_argument("--policy", **many, dest="policies", metavar="P", help="names, files or folders")
    parser.add_argument("--n-action-steps", **many, type=int, metavar="K", help="actions per inference")
    parser.add_argument("--episodes", type=int, metavar="N", help=f"per policy and world ({EPISODES})")
    parser.add_argument("--seed-start", type=int, metavar="S", help="seed of the first episode (1)")
    parser.add_argument("--workers", type=workers_argument, metavar="W", help="processes, or 'auto'")
    add_cluster(parser)
    _add_interventions(parser)
    parser.add_argument("--out", type=Path, default=Path("runs/probe"), metavar="DIR", help="(runs/probe)")
    add_shard(parser)
    add_json_progress(parser)
    add_overrides(parser, help="change any field of the evaluations")
    parser.add_argument("--format", choices=FORMATS, default="markdown", help="(markdown)")
    add_allow_environment_change(parser)


def _add_interventions(parser: argparse.ArgumentParser) -> None:
    many: dict[str, Any] = {"nargs": "+", "action": "extend"}  # Any: argparse's keyword arguments
    parser.add_argument(
        "--probe",
        **many,
        dest="probes",
        type=_one_or_several,
        metavar="P",
        help="what to change, by spaces or commas (swap,blank,delay,reset)",
    )
    parser.add_argument("--swap", **many, type=int, dest="swaps", metavar="K", help="which other cues (1)")
    parser.add_argument(
        "--delay", **many, type=int, dest="delays", metavar="L", help="steps (0 5 10 20 40 80 160 320)"
    )
    parser.add_argument("--cue", **many, type=int, dest="cues", metavar="L", help="steps of the cue (1 2 3)")
    parser.add_argument(
        "--mask", **many, dest="masks", metavar="M", help="what is hidden (cue elsewhere later)"
    )
    parser.add_argument(
        "--late", **many, type=int, dest="lates", metavar="L", help="steps before the cue (5 20)"
    )
    parser.add_argument(
        "--appearance",
        **many,
        dest="appearances",
        metavar="A",
        help="what looks different (light camera table hue)",
    )
    parser.add_argument("--distract", **many, type=int, dest="distractors", metavar="L", help="steps (3)")
    parser.add_argument(
        "--instruction",
        **many,
        dest="instructions",
        metavar="SET",
        help="prompt sets (paraphrased other_task no_content)",
    )
    parser.add_argument(
        "--reset-at",
        **many,
        type=int,
        dest="reset_steps",
        metavar="S",
        help="control steps (the end of the cue, the beginning of the response)",
    )
    add_grid_arguments(parser)
    parser.add_argument("--no-controls", action="store_true", help="run only the policies that are named")


def _one_or_several(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def run(args: argparse.Namespace) -> int:
    """Run the evaluations, then print the table to standard output; everything else to standard error.

    Raises:
        VlaEvalError: a mistyped name, a run folder of other settings, or a fault of every episode.
    """
    # Here and not above: `mikasa-vla --help` need not wait for statistics and progress bars.
    from vla_eval.probe.interventions import plan_probe
    from vla_eval.probe.page.retention_plot import write_retention
    from vla_eval.probe.probe_text import render_probe
    from vla_eval.probe.table import read_probe

    if args.grid:
        return run_grid(args, _config(args), _grid_settings(args))
    if args.first_inferences is not None:
        raise RecipeError("--first-inference is of a grid. Add --grid.")
    probe = plan_probe(_config(args), _settings(args))
    for pair in probe.left_out:
        print(f"left out: {pair}", file=sys.stderr)
    stopped = run_all([world.config for world in probe.worlds], args)
    if stopped is not None:
        return stopped
    table = read_probe(probe.worlds, args.out)
    for path in write_retention(table, args.out):
        print(f"retention curve: {path}", file=sys.stderr)
    print_in(args.format, render_probe(table, args.format))
    return EXIT_EPISODE_ERRORS if table.n_errors else 0


def _settings(args: argparse.Namespace) -> "ProbeSettings":
    from vla_eval.probe.interventions import INTERVENTIONS
    from vla_eval.probe.worlds import APPEARANCES, MASKS, ProbeSettings

    chosen: dict[str, Any] = {  # Any: tuples of words or numbers
        name: _numbers(getattr(args, name), name) for name in FLAGS
    }
    if args.instructions is not None:
        chosen["instructions"] = tuple(dict.fromkeys(args.instructions))
    words = None if args.probes is None else [word for words in args.probes for word in words]
    chosen["probes"] = _names(words, INTERVENTIONS, kind="probe", flag="--probe")
    chosen["masks"] = _names(args.masks, MASKS, kind="mask", flag="--mask")
    chosen["appearances"] = _names(args.appearances, APPEARANCES, kind="appearance", flag="--appearance")
    given = {name: value for name, value in chosen.items() if value is not None}
    return ProbeSettings(**given, controls=not args.no_controls)


def _grid_settings(args: argparse.Namespace) -> "GridSettings":
    from vla_eval.probe.grid import AXES, GridSettings

    words = [word for words in args.probes or () for word in words]
    for word in words:
        if word not in AXES:
            raise RecipeError(f"--grid: --probe {word}: expected {' or '.join(AXES)}. Run it without --grid.")
    others = [flag for name, flag in OF_NO_GRID.items() if getattr(args, name) is not None]
    if others:
        raise RecipeError(f"--grid has no {', '.join(others)}. Run it without --grid.")
    given = {name: _numbers(getattr(args, name), name) for name in ("delays", "cues", "first_inferences")}
    chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if words:
        chosen["axes"] = tuple(dict.fromkeys(words))
    return GridSettings(**chosen, controls=not args.no_controls)


OF_NO_GRID = {
    "swaps": "--swap",
    "masks": "--mask",
    "lates": "--late",
    "appearances": "--appearance",
    "distractors": "--distract",
    "instructions": "--instruction",
    "reset_steps": "--reset-at",
}
"""Attribute -> flag of what only other interventions have."""

FLAGS = {
    "swaps": ("--swap", 1),
    "delays": ("--delay", 0),
    "cues": ("--cue", 1),
    "lates": ("--late", 1),
    "distractors": ("--distract", 1),
    "reset_steps": ("--reset-at", 1),
}
"""Attribute -> flag and least value."""
GRID_FLAGS = {"first_inferences": ("--first-inference", 0)}


def _names(
    words: list[str] | None, known: Collection[str], *, kind: str, flag: str
) -> tuple[str, ...] | None:
    for word in words or ():
        if word not in known:
            raise unknown_name(kind, word, known, where=flag)
    return None if words is None else tuple(dict.fromkeys(words))


def _numbers(values: list[int] | None, name: str) -> tuple[int, ...] | None:
    if values is None:
        return None
    flag, least = {**FLAGS, **GRID_FLAGS}[name]
    for value in values:
        if value < least:
            raise RecipeError(f"{flag} {value}: expected a whole number ≥ {least}.")
    return tuple(dict.fromkeys(values))


def _config(args: argparse.Namespace) -> EvalConfig:
    """Return the configuration that all worlds share: the file, the flags, `--set`."""
    edit = _editor(args)
    if args.config is not None:
        return load_recipe("configs", args.config, EvalConfig, edit=edit).value
    data: dict[str, Any] = {"name": "probe", "episodes": EPISODES}  # Any: plain data of YAML
    edit(data)
    for flag, field in (("--task", "tasks"), ("--policy", "policies")):
        if field not in data:
            raise RecipeError(
                f"Name a configuration, or at least one --task and one --policy; {flag} is missing. Example: "
                "mikasa-vla probe --task RememberColor3-v0 --policy memory_color3"
            )
    return decode(EvalConfig, data, where="command line")


def _editor(args: argparse.Namespace) -> Callable[[dict[str, Any]], None]:
    def edit(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        for name in ("tasks", "policies", "n_action_steps", "episodes", "seed_start", "workers"):
            value = getattr(args, name)
            if value is not None:
                data[name] = value
        apply_overrides(data, args.overrides, cls=EvalConfig)

    return edit
