"""Tables and pages of an evaluation, as its verbs print and write them."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.cli.shared.arguments import add_flags
from vla_eval.cli.terminal.screen import print_markdown, screen_width
from vla_eval.errors import unknown_name
from vla_eval.results.formats import PRESETS
from vla_eval.storage.shard import Shard

if TYPE_CHECKING:
    from vla_eval.results.imported.rows import ImportedRow
    from vla_eval.storage.run_folder import StoredRun


DEFAULT_BOARD = "leaderboard_mikasa"


def add_table_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how the table is printed."""
    add_flags(parser, "--format")
    parser.add_argument("--wide", action="store_true", help="every column, and a row per run")
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        help="of --format latex: a table as in papers, tasks as columns, the best policy in bold",
    )
    parser.add_argument(
        "--baseline",
        metavar="NAME",
        help="policy that the others are compared with (cue_blind and random, if they were run)",
    )
    parser.add_argument(
        "--paper", action="store_true", help="print the paper's figures for the same tasks beside yours"
    )
    parser.add_argument(
        "--published",
        nargs="?",
        const=DEFAULT_BOARD,
        metavar="NAME",
        help=f"print published results beside yours, with their sources ({DEFAULT_BOARD})",
    )


def print_table(
    runs: "Sequence[StoredRun]", args: argparse.Namespace, *, columns: "Sequence[str]" = ()
) -> None:
    """Print the table of all runs in the format that was asked for."""
    from vla_eval.results.report import build_table, render

    table = build_table(runs, baseline=args.baseline, protocols=getattr(args, "protocols", ()))
    text = render(
        table,
        args.format,
        paper=args.paper,
        published=args.published,
        imported=imported_rows(getattr(args, "imported", ())),
        columns=columns,
        wide=args.wide,
        preset=args.preset,
        width=screen_width(),
    )
    print_in(args.format, text)
    if args.format == "csv":  # has no place for them
        for note in table.notes:
            print(f"note: {note}", file=sys.stderr)


def imported_rows(paths: "Sequence[Path]") -> "list[ImportedRow]":
    """Read the results of other programs, each file once."""
    from vla_eval.results.imported.reading import read_imported

    return [row for path in dict.fromkeys(paths) for row in read_imported(path)]


def print_in(fmt: str, text: str) -> None:
    """Print what was written in a format; only Markdown is wrapped to a terminal."""
    if fmt == "markdown":
        print_markdown(text)
    else:
        print(text)


def check_table_arguments(args: argparse.Namespace) -> None:
    """Refuse a combination that no table has, before the run and not after it."""
    from vla_eval.results.published.literature import load_published
    from vla_eval.results.table_formats import check_format

    beside = args.paper or args.published is not None
    check_format(args.format, columns=(), wide=args.wide, preset=args.preset, beside=beside)
    if args.published is not None:
        load_published().of_board(args.published)


def write_html(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    """Write the report page and say where."""
    from vla_eval.page.build import write_page

    page = write_page(runs, args.html, baseline=args.baseline, published=args.published)
    sys.stdout.flush()  # the table first, wherever the two go
    print(f"Report page: {page}", file=sys.stderr)


def print_shard(folder: Path, whole: Path, shard: Shard) -> None:
    """Print the folder of a finished shard, and how the shards become one run."""
    print(folder, flush=True)
    hint_merge(whole, shard)


def hint_merge(whole: Path, shard: Shard) -> None:
    """Say on standard error how the shards become one run."""
    print(
        f"Shard {shard} is done. When all are: mikasa-vla merge {whole}-shard-*-of-{shard.count} "
        f"--out {whole}; then the same command without --shard prints the result.",
        file=sys.stderr,
    )


def say(line: str) -> None:
    """Print a line for a person to standard error, at once."""
    print(line, file=sys.stderr, flush=True)


def hint_next(*words: object) -> None:
    """Say on standard error which command comes next."""
    print(f"Next: {shlex.join(['mikasa-vla', *map(str, words)])}", file=sys.stderr)


def check_baseline(baseline: str | None, policies: Sequence[str]) -> None:
    """Refuse a baseline that is not evaluated, before the run and not after it."""
    if baseline is not None and baseline not in policies:
        raise unknown_name("policy", baseline, policies, where="--baseline")
