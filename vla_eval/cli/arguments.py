"""What several verbs share: kinds of arguments, exit codes, what was typed."""

import argparse
import shlex
import sys

EXIT_EPISODE_ERRORS = 3
"""All episodes were played, and some ended in an error."""


def typed_command() -> str:
    """Return the command that is running, as a shell takes it."""
    return shlex.join(["mikasa-vla", *sys.argv[1:]])


def workers_argument(text: str) -> int | str:
    """Read the value of `--workers`: a number, or `auto`."""
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError as exc:
        raise argparse.ArgumentTypeError(f"expected 'auto' or a number, found '{text}'") from exc
