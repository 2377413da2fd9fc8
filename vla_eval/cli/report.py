"""`mikasa-vla report`: print the success table of one or more run folders, or write it as a page."""

import argparse
import sys
from pathlib import Path
from typing import Any

# Not taken from vla_eval.results: importing that would make `mikasa-vla --help` wait for scipy.
FORMATS = ("markdown", "csv", "json", "latex")
DESCRIPTION = """Print the success table of one or more run folders; standard output carries nothing else.

Each RUN is a folder that `mikasa-vla eval` made; a run may still be unfinished. Several runs go into one
table: rows with the same task, policy, n_action_steps and settings are put together.

With --html, a page with plots, choices, errors and videos is written instead, and its path printed."""


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    parser = subparsers.add_parser(
        "report",
        help="print the success table of run folders",
        description=DESCRIPTION,
        epilog="The columns are explained in docs/statistics.md.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folder (runs/…)")
    parser.add_argument(
        "--baseline",
        metavar="NAME",
        help="policy that the others are compared with (random, if it was run)",
    )
    parser.add_argument("--format", choices=FORMATS, default="markdown", help="(markdown)")
    parser.add_argument(
        "--columns",
        nargs="+",
        default=[],
        metavar="NAME",
        help="only these, in this order, in markdown or latex: task policy K variant episodes errors success "
        "at_end first_choice chose right_if_chose steps inferences difference chance ceiling corrected",
    )
    parser.add_argument(
        "--html", type=Path, metavar="DIR", help="write a page that needs no network: DIR/index.html"
    )
    parser.add_argument(
        "--paper", action="store_true", help="print the paper's figures for the same tasks beside yours"
    )


def run(args: argparse.Namespace) -> int:
    """Read the runs, and print their table or write their page.

    Raises:
        VlaEvalError: a RUN is no run folder, holds nothing yet, or has no such baseline.
    """
    # Here and not above: `mikasa-vla --help` need not wait for statistics.
    from vla_eval.results.report import build_table, render
    from vla_eval.storage.run_folder import read_run

    runs = [read_run(path) for path in args.runs]
    if args.html is not None:
        from vla_eval.errors import ReportError
        from vla_eval.page.build import write_page

        if args.paper or args.columns or args.format != "markdown":
            raise ReportError(
                "--html writes a page, which --format, --columns and --paper say nothing of. Drop them."
            )
        print(write_page(runs, args.html, baseline=args.baseline))
        return 0
    table = build_table(runs, baseline=args.baseline)
    print(render(table, args.format, paper=args.paper, columns=args.columns))
    if args.format == "csv":  # has no place for them
        for note in table.notes:
            print(f"note: {note}", file=sys.stderr)
    return 0
