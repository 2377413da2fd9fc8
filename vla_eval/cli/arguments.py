"""What several verbs share: kinds of arguments, exit codes."""

import argparse

EXIT_EPISODE_ERRORS = 3
"""All episodes were played, and some ended in an error."""


def workers_argument(text: str) -> int | str:
    """Read the value of `--workers`: a number, or `auto`."""
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError as exc:
        raise argparse.ArgumentTypeError(f"expected 'auto' or a number, found '{text}'") from exc
