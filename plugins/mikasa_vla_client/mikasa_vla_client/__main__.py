"""`python -m mikasa_vla_client ws://HOST:PORT`: check a server, print what holds."""

from __future__ import annotations

import argparse
import os
import sys
from typing import Sequence

from mikasa_vla_client.check import CheckFailedError, check_remote
from mikasa_vla_client.plain_text import LINES, printable


def main(argv: Sequence[str] | None = None) -> int:
    """Check; return 0 if every requirement is met, otherwise 1."""
    parser = argparse.ArgumentParser(prog="mikasa_vla_client", description="Check a policy server.")
    parser.add_argument("url", metavar="URL", help="ws://HOST:PORT of the server")
    parser.add_argument("--api-key-env", metavar="VAR", help="variable that holds the server's key")
    args = parser.parse_args(argv)
    key = os.environ.get(args.api_key_env) if args.api_key_env else None
    if args.api_key_env and not key:
        parser.error(f"--api-key-env: the variable {args.api_key_env} is not set")
    try:
        check_remote(args.url, api_key=key, report=_say_met)
    except CheckFailedError as exc:
        print(printable(str(exc), keep=LINES), file=sys.stderr)
        return 1
    return 0


def _say_met(claim: str) -> None:
    print("ok  " + printable(claim, keep=LINES), flush=True)


if __name__ == "__main__":
    sys.exit(main())
