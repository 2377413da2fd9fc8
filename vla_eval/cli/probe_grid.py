"""`mikasa-vla probe --grid`: chunk lengths against the lengths of the phases."""

import argparse
import sys
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS
from vla_eval.cli.shared.output import print_in
from vla_eval.cli.shared.probe_runs import run_all
from vla_eval.config.evaluation import EvalConfig

if TYPE_CHECKING:
    from vla_eval.probe.grid import GridSettings


def add_grid_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the grid."""
    many: dict[str, Any] = {"nargs": "+", "action": "extend"}  # Any: argparse's keyword arguments
    parser.add_argument(
        "--grid",
        action="store_true",
        help="each --n-action-steps (1 2 4 8) with each --delay (0 5 20 80); with --probe cue or delay,cue: "
        "with each --cue (1 2 3 5)",
    )
    parser.add_argument(
        "--first-inference",
        **many,
        type=int,
        dest="first_inferences",
        metavar="S",
        help="of a grid: control steps of the first inference (all below K if K does not divide the phases)",
    )


def run_grid(args: argparse.Namespace, config: EvalConfig, settings: "GridSettings") -> int:
    """Run the evaluations of a grid, print its table and write its heat maps.

    Raises:
        VlaEvalError: as for `probe`.
    """
    from vla_eval.probe.grid import plan_grid
    from vla_eval.probe.grid_table import read_grid
    from vla_eval.probe.grid_text import render_grid
    from vla_eval.probe.page.heat_maps import write_heat_maps

    grid = plan_grid(config, settings)
    for task in grid.left_out:
        print(f"left out: {task}", file=sys.stderr)
    print(f"{len(grid.worlds)} run folders, {grid.n_episodes} episodes", file=sys.stderr)
    stopped = run_all([world.config for world in grid.worlds], args)
    if stopped is not None:
        return stopped
    table = read_grid(grid.worlds, args.out)
    print_in(args.format, render_grid(table, args.format))
    sys.stdout.flush()  # the table first, wherever the two go
    for path in write_heat_maps(table, args.out):
        print(f"Heat map: {path}", file=sys.stderr)
    return EXIT_EPISODE_ERRORS if table.n_errors else 0
