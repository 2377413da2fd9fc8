"""`mikasa-vla report`: print the success table of one or more run folders, or write it as a page."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vla_eval.cli.shared.arguments import MANY
from vla_eval.cli.shared.output import add_table_arguments, imported_rows, print_in, print_table
from vla_eval.cli.terminal.screen import print_markdown
from vla_eval.errors import ReportError, some_of

if TYPE_CHECKING:
    from vla_eval.results.success_table import Table
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
    wanted = _wanted(args)
    for name in wanted:
        _check_alone(_WRITERS[name].words, args)
    for name in wanted:
        _WRITERS[name].write(runs, args)
    if wanted:
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
    if is_none or _wanted(args):
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


def _wanted(args: argparse.Namespace) -> list[str]:
    """Return what is written in place of the table."""
    return [name for name in _WRITERS if getattr(args, name) is not None]


def _write_html(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
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


def _write_filmstrips(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    from vla_eval.page.filmstrip import N_EPISODES, write_filmstrips

    made = write_filmstrips(runs, args.filmstrip)
    print("\n".join(map(str, made.files)))
    if made.not_captured:
        print(f"Not captured (--capture-video {N_EPISODES}): {some_of(made.not_captured)}", file=sys.stderr)


def _write_export(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    from vla_eval.results.exported.file import export_text

    _write_text(args.export, export_text(_table(runs, args)))


def _write_card(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> None:
    from vla_eval.results.exported.model_card import with_results

    try:
        text = args.card.read_text(encoding="utf-8") if args.card.exists() else ""
    except UnicodeDecodeError as exc:
        raise ReportError(f"{args.card}: expected a model card, found {exc}.") from exc
    _write_text(args.card, with_results(text, _table(runs, args), where=str(args.card)))


def _table(runs: "Sequence[StoredRun]", args: argparse.Namespace) -> "Table":
    from vla_eval.results.report import build_table

    return build_table(runs, baseline=args.baseline, protocols=args.protocols)


def _write_text(file: Path, text: str) -> None:
    from vla_eval.storage.durable import replace_file

    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, text)
    print(file)


class _Writer(NamedTuple):
    """What is written in place of the table, in words, and what writes it."""

    words: str
    write: "Callable[[Sequence[StoredRun], argparse.Namespace], None]"


_WRITERS: Mapping[str, _Writer] = {
    "html": _Writer("--html writes a page", _write_html),
    "filmstrip": _Writer("--filmstrip writes a contact sheet", _write_filmstrips),
    "export": _Writer("--export writes a file", _write_export),
    "card": _Writer("--card writes into a file", _write_card),
}
"""By the flag, in this order."""
