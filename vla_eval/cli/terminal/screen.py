"""Fit text to the terminal; not by rich, which breaks commands and slows down `--help`."""

import os
import re
import shutil
import sys
import textwrap
from typing import TextIO

WIDEST, NARROWEST = 100, 40
"""Characters. Longer lines are hard to read, shorter ones hold no sentence."""
ITEM = "- "  # of a list
UNKNOWN_LINES = 24  # `get_terminal_size` wants them; nobody asks
UNBROKEN = re.compile(r"\S*`[^`]+`\S*|(?<=: )mikasa-vla .*|\S+")
"""Words; a command in quotes, or from a colon to the end, is one: it must be copied without a line break."""


def screen_width(*, widest: int | None = WIDEST) -> int | None:
    """Return how wide a printed line may be (a table: `widest` None); None where output is not a terminal."""
    if not sys.stdout.isatty():
        return None
    columns = shutil.get_terminal_size((WIDEST, UNKNOWN_LINES)).columns
    return max(columns if widest is None else min(columns, widest), NARROWEST)


def message_width(stream: TextIO) -> int | None:
    """Return how many characters a line of a message may have; None where the stream is not a terminal."""
    try:
        if not stream.isatty():
            return None
        columns = os.get_terminal_size(stream.fileno()).columns or WIDEST  # 0: the terminal does not know
    except (OSError, ValueError):  # no descriptor, or closed
        return None
    return max(min(columns, WIDEST), NARROWEST)


def folded(text: str, width: int) -> str:
    """Return lines of at most so many characters, but for commands, code and long words."""
    return "".join(_folded_line(line, width) for line in text.splitlines(keepends=True))


def _folded_line(line: str, width: int) -> str:
    if len(line.rstrip("\n")) <= width or line[0].isspace():
        return line
    lines = [""]
    for word in UNBROKEN.findall(line):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append("")
        lines[-1] += f" {word}" if lines[-1] else word
    return "\n".join(lines) + ("\n" if line.endswith("\n") else "")


def print_markdown(text: str) -> None:
    """Print tables as they are, and wrap all other lines where a terminal would break them inside words."""
    width = screen_width()
    print(text if width is None else wrapped(text, width))


def wrapped(text: str, width: int) -> str:
    """Return Markdown whose lines have at most so many characters, but for tables and long words."""
    return "\n".join(_wrapped_line(line, width) for line in text.splitlines())


def _wrapped_line(line: str, width: int) -> str:
    if len(line) <= width or line.startswith("|"):
        return line
    mark = ITEM if line.startswith(ITEM) else ""
    return filled(line.removeprefix(mark), width, first=mark, rest=" " * len(mark))


def filled(text: str, width: int, *, first: str, rest: str) -> str:
    """Return the text in lines of at most so many characters that begin with `first`, then with `rest`."""
    return textwrap.fill(
        text,
        width,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
