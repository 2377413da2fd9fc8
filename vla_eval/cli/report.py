"""`mikasa-vla report`: print the success table of one or more run folders, or write it as a page."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.cli.shared.arguments import MANY
from vla_eval.cli.shared.output import add_table_arguments, imported_rows, print_in, print_table
from vla_eval.cli.terminal.screen import print_markdown
from vla_eval.errors import ReportError, some_of

if TYPE_CHECKING:
    from vla_eval.storage.run_folder import StoredRun

DESCRIPTION = """Print the success table of one or more run folders; standard output carries nothing else.

Each RUN is a folder that `mikasa-vla eval` made; a run may still be unfinished. Several runs go into one
table: rows with the same task, policy, n_action_steps and settings are put together. Without a RUN,
--published and --imported print published and imported results alone.

With --html, a page with plots, choices, errors and videos is written instead, and its path printed. With
--filmstrip, an image per row of the table: ten seeds, cue | reveal | touch. With --export, a JSON file for
other programs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, "The columns are explained in docs/statistics.md."
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run folder (runs/…)")
    add_table_arguments(parser)
    parser.add_argument(
        "--protocol",
        action="append",
        default=[],
        dest="protocols",
        metavar="NAME",
        help="also print the summary figure of this protocol (`mikasa-vla list protocols`); those that the "
        "runs name are always printed",
    )
    parser.add_argument(
        "--imported",
        **MANY,
        default=[],
        type=Path,
        metavar="FILE",
        help="print results that other programs counted beside yours (docs/imported.md lists the programs)",
    )
    columns = parser.add_argument("--columns", **MANY, default=[], metavar="NAME")
    columns.help = "only these, in this order, in formats for reading: %(names)s"
    vars(columns)["names"] = _ColumnNames()  # argparse puts it into the help
    parser.add_argument(
        "--html", type=Path, metavar="DIR", help="write a page that needs no network: DIR/index.html"
    )

    parser.add_argument(
        "--export",
        type=Path,
        metavar="FILE",
        help="write rows and passports as JSON with a schema, for other programs (docs/exported.md)",
    )
    parser.add_argument(
        "--card",
        type=Path,
        metavar="FILE",
        help="write the rows of one policy into the model-index of a model card, README.md of a checkpoint",
    )
    parser.add_argument(
        "--filmstrip",
        type=Path,
        metavar="DIR",
        help="write DIR/TASK_POLICY_Kn.png for each row with captured episodes (eval --capture-video)",
    )


class _ColumnNames:
    """The names of the columns, read when a help is shown: `mikasa-vla --help` need not wait for scipy."""

    def __str__(self) -> str:
        from vla_eval.results.statistics import printed_columns

        return " ".join(printed_columns())


def run(args: argparse.Namespace) -> int:
    """Read the runs, and print their table or write their page."""
    from vla_eval.probe.probe_text import probe_texts
    from vla_eval.storage.run_folder import read_run

    if not args.runs:
        return _print_beside(args)
    runs = [read_run(path) for path in args.runs]
    if args.html is not None:
        _check_alone("--html writes a page", args)
    if args.filmstrip is not None:
        _check_alone("--filmstrip writes a contact sheet", args)
    if args.export is not None:
        _check_alone("--export writes a file", args)
    if args.card is not None:
        _check_alone("--card writes into a file", args)
    if args.html is not None:
        from vla_eval.page.build import write_page
        from vla_eval.probe.page.sections import probe_sections

        page = write_page(
            runs,
            args.html,
            baseline=args.baseline,
            probes=probe_sections(runs),
            protocols=args.protocols,
            published=args.published,
        )
        print(page)
    if args.filmstrip is not None:
        _write_filmstrips(runs, args.filmstrip)
    if args.export is not None:
        _export(runs, args)
    if args.card is not None:
        _write_card(runs, args)
    if any(one is not None for one in (args.html, args.filmstrip, args.export, args.card)):
        return 0
    print_table(runs, args, columns=args.columns)
    if args.format == "markdown":
        for text in probe_texts(runs):
            print_markdown(f"\n{text}")
    return 0


def _print_beside(args: argparse.Namespace) -> int:
    """Print published and imported results alone."""
    from vla_eval.results.table_formats import render_beside

    is_none = args.published is None and not args.imported
    if is_none or any(one is not None for one in (args.html, args.filmstrip, args.export, args.card)):
        raise ReportError("Name at least one RUN, a run folder, or --published or --imported alone.")
    rows = imported_rows(args.imported)
    print_in(args.format, render_beside(args.format, published=args.published, imported=rows))
    return 0


def _check_alone(written: str, args: argparse.Namespace) -> None:
    others = (args.paper, args.columns, args.wide, args.preset, args.imported, args.format != "markdown")
    if any(others):
        raise ReportError(
            f"{written}, which has no --format, --preset, --columns, --wide, --paper and --imported. Remove "
            "them."
        )


def _export(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    from vla_eval.results.export import export_text
    from vla_eval.results.report import build_table
    from vla_eval.storage.durable import replace_file

    table = build_table(runs, baseline=args.baseline, protocols=args.protocols)
    args.export.parent.mkdir(parents=True, exist_ok=True)
    replace_file(args.export, export_text(table))
    print(args.export)


def _write_card(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    from vla_eval.results.model_card import with_results
    from vla_eval.results.report import build_table
    from vla_eval.storage.durable import replace_file

    try:
        text = args.card.read_text(encoding="utf-8") if args.card.exists() else ""
    except UnicodeDecodeError as exc:
        raise ReportError(f"{args.card}: expected a model card, found {exc}.") from exc
    table = build_table(runs, baseline=args.baseline, protocols=args.protocols)
    new = with_results(text, table, where=str(args.card))
    args.card.parent.mkdir(parents=True, exist_ok=True)
    replace_file(args.card, new)
    print(args.card)


def _write_filmstrips(runs: "Sequence[StoredRun]", folder: Path) -> None:
    from vla_eval.page.filmstrip import N_EPISODES, write_filmstrips

    made = write_filmstrips(runs, folder)
    print("\n".join(map(str, made.files)))
    if made.not_captured:
        print(f"Not captured (--capture-video {N_EPISODES}): {some_of(made.not_captured)}", file=sys.stderr)
