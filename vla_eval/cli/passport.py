"""`mikasa-vla passport`: how a figure was made, and whether two may stand side by side."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.cli.shared.arguments import add_flags
from vla_eval.cli.shared.output import print_in

if TYPE_CHECKING:
    from vla_eval.results.side_by_side.written import Figure

DESCRIPTION = """Print how the figures of a run folder, or of a published result, were made: tasks and their
version, instructions, control mode, images, robot, horizon, K, execution, delay, success rule, simulator,
seeds, weights.

With two of them, also what differs, and what that may do to the figures. What is not known is unknown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, "docs/passport.md explains the fields."
    what = "run folder, file of another program, or published result (runs/first, eval_info.json, GMP)"
    parser.add_argument("first", metavar="A", help=what)
    parser.add_argument("second", nargs="?", metavar="B", help="likewise")
    add_flags(parser, "--format")


def run(args: argparse.Namespace) -> int:
    """Print one passport, or two; 0 also where they differ."""
    from vla_eval.results.side_by_side.written import render_passports

    figures = _figures([name for name in (args.first, args.second) if name is not None])
    rendered = render_passports(figures, args.format)
    print_in(args.format, rendered.text)
    if args.format == "csv":  # has no place for them
        for note in rendered.notes:
            print(f"note: {note}", file=sys.stderr)
    return 0


def _figures(names: Sequence[str]) -> "list[Figure]":
    """Read each run folder and file there is, and look for a published result of each other name."""
    from vla_eval.results.imported.reading import read_imported
    from vla_eval.results.passport.passport import merged
    from vla_eval.results.published.literature import load_published
    from vla_eval.results.published.passports import find_published, passport_of_published
    from vla_eval.results.side_by_side.written import Figure, figure_of_run
    from vla_eval.storage.run_folder import read_run

    published, found = load_published(), {}
    for name in names:
        if Path(name).is_file():
            rows = read_imported(Path(name))
            found[name] = Figure(passport=merged([one.passport for one in rows], subject=name))
        elif Path(name).exists() or "/" in name:
            found[name] = figure_of_run(read_run(Path(name)))
    tasks = {task for figure in found.values() for task in figure.tasks}
    for name in names:
        if name not in found:
            result = find_published(published, name)
            found[name] = Figure(passport=passport_of_published(result, published, tasks=tasks))
    return [found[name] for name in names]
