"""Tables and pages of an evaluation, as its verbs print and write them."""

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vla_eval.errors import unknown_name

if TYPE_CHECKING:
    from vla_eval.storage.run_folder import StoredRun


def print_table(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    """Print the table of all runs in the format that was asked for."""
    from vla_eval.results.report import build_table, render

    table = build_table(runs, baseline=args.baseline)
    print(render(table, args.format, paper=args.paper))
    if args.format == "csv":  # has no place for them
        for note in table.notes:
            print(f"note: {note}", file=sys.stderr)


def write_html(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    """Write the report page and say where."""
    from vla_eval.page.build import write_page

    page = write_page(runs, args.html, baseline=args.baseline)
    sys.stdout.flush()  # the table first, wherever the two go
    print(f"Report page: {page}", file=sys.stderr)


def check_baseline(baseline: str | None, policies: Sequence[str]) -> None:
    """Refuse a baseline that is not evaluated, before the run and not after it.

    Raises:
        UnknownNameError: it is none of the policies.
    """
    if baseline is not None and baseline not in policies:
        raise unknown_name("policy", baseline, policies, where="--baseline")
