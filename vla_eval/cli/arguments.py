"""Kinds of arguments that several verbs take."""

import argparse


def workers_argument(text: str) -> int | str:
    """Read the value of `--workers`: a number, or `auto`."""
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError as exc:
        raise argparse.ArgumentTypeError(f"expected 'auto' or a number, found '{text}'") from exc
