"""`mikasa-vla compare`: chunk lengths, or policies, against a reference on the same episodes."""

import argparse
import sys
from pathlib import Path

from vla_eval.cli.shared.arguments import add_flags
from vla_eval.cli.shared.output import print_in
from vla_eval.cli.terminal.screen import screen_width
from vla_eval.results.formats import COMPARED_BY

DESCRIPTION = """Compare what was evaluated on the same seeds: success by n_action_steps (K) with intervals,
chance and ceiling at the same K, frames of the cue that each K let the policy see, an exact paired
test against a reference, and how many episodes would settle a difference.

Each RUN is a folder that `mikasa-vla eval` made; several are put together."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, "docs/chunk_sizes.md explains the columns."
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folder (runs/…)")
    parser.add_argument("--by", choices=COMPARED_BY, default="n_action_steps", help="(n_action_steps)")
    parser.add_argument(
        "--reference", metavar="NAME", help="a K, or a policy (the smallest K, or the first policy)"
    )
    parser.add_argument(
        "--difference", type=float, default=0.1, metavar="D", help="difference to plan for (0.1)"
    )
    add_flags(parser, "--format")


def run(args: argparse.Namespace) -> int:
    """Print the comparison."""
    from vla_eval.results.sweep import compare_runs
    from vla_eval.results.sweep_format import render_sweep, sweep_table
    from vla_eval.storage.run_folder import read_run

    sweep = compare_runs(
        [read_run(path) for path in args.runs],
        by=args.by,
        reference=args.reference,
        difference=args.difference,
    )
    print_in(args.format, render_sweep(sweep, args.format, width=screen_width()))
    if args.format == "csv":  # has no place for them
        for note in sweep_table(sweep).notes:
            print(f"note: {note}", file=sys.stderr)
    return 0
