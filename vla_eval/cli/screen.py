"""Fit Markdown to the terminal that it is printed on. In a file or a pipe, a paragraph stays one line."""

import shutil
import sys
import textwrap

WIDEST, NARROWEST = 100, 40
"""Characters. Longer lines are hard to read, shorter ones hold no sentence."""
ITEM = "- "  # of a list
UNKNOWN_LINES = 24  # `get_terminal_size` wants them; nobody asks


def screen_width() -> int | None:
    """Return how many characters a printed line may have; None where standard output is no terminal."""
    if not sys.stdout.isatty():
        return None
    columns = shutil.get_terminal_size((WIDEST, UNKNOWN_LINES)).columns
    return min(max(columns, NARROWEST), WIDEST)


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
    return textwrap.fill(
        line.removeprefix(mark),
        width,
        initial_indent=mark,
        subsequent_indent=" " * len(mark),
        break_long_words=False,
        break_on_hyphens=False,
    )
