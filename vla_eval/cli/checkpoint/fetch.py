"""`mikasa-vla checkpoint fetch`: what `checkpoint` does for the published bases of recipes."""

import argparse
import sys
from pathlib import Path
from typing import Any

from vla_eval.models.families import bases

FETCH = "fetch"
DESCRIPTION = """Fetch a published checkpoint that recipes start from, check every file, and convert it where
needed. It shows the licence, and the size and the free disk, before it fetches. The same command again
resumes, or checks what is there. Names: """


def add_parsers(actions: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    fetch = actions.add_parser(
        FETCH,
        help="get a published base from the Hub",
        description=f"{DESCRIPTION}{', '.join(bases())}.",
        allow_abbrev=False,
    )
    fetch.add_argument(
        "name", metavar="NAME", help="of a base, of a recipe that starts from it, or hub:OWNER/NAME@REVISION"
    )
    fetch.add_argument("--out", type=Path, metavar="DIR", help="folder to make (checkpoints/NAME)")
    fetch.add_argument("--revision", metavar="REV", help="branch, tag or commit (the pinned one)")


def run(args: argparse.Namespace) -> list[str]:
    """Do it; return lines for standard output."""
    # Here and not above: `mikasa-vla --help` need not wait for the Hub's client.
    from vla_eval.checkpoints.bases import FOLDER, find_base
    from vla_eval.checkpoints.fetching import fetch_base

    base = find_base(args.name)
    out = args.out or FOLDER / base.name

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    return [str(fetch_base(base, out, revision=args.revision, say=say))]
