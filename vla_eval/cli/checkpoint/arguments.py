"""Arguments that several conversions of checkpoints have."""

import argparse


def add_gripper(convert: argparse.ArgumentParser) -> None:
    """Declare `--gripper`; `conversion.writing.stated_gripper` says what it means and asks for it."""
    names = "unit_open, unit_closed, maniskill or negated"
    convert.add_argument("--gripper", metavar="NAME", help=f"how its data encode it, has to be said: {names}")
