r"""Text without control characters: what others wrote must not move the cursor, or hide what is printed.

All text that is printed goes through `PlainStream`, and all text that has to fit into one line through
`printable`. Everything but letters, signs and spaces is shown as its escape: `\u001b`, which is also JSON's.

This file runs with Python 3.8 and imports nothing else: `mikasa_vla_client` ships it, too.
"""

from __future__ import annotations

import re
import unicodedata
from typing import Any, TextIO  # Any: whatever a text stream has

SHORT = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}
LINES = "\n\t"
"""Kept in text of several lines."""
CURSOR_UP = re.compile(r"\n*(\x1b\[A)+")  # how tqdm goes back to a bar that is not the last one


def printable(text: str, *, keep: str = "") -> str:
    """Return the text with an escape for each letter, but those of `keep`, that does not print as itself."""
    rest = text
    for letter in keep:
        rest = rest.replace(letter, "")
    if rest.isprintable():  # nearly always, and fast
        return text
    return "".join(letter if letter in keep or _is_sign(letter) else _escaped(letter) for letter in text)


def _is_sign(letter: str) -> bool:
    return letter.isprintable() or unicodedata.category(letter) == "Zs"  # all widths of spaces


def _escaped(letter: str) -> str:
    code = ord(letter)
    return SHORT.get(letter) or (f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}")


class PlainStream:
    """A text stream to which only printable text, line ends and tabs are written.

    On a terminal, progress bars of tqdm may go back to the beginning of their line, but not of another one's.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._line = ""  # what the line under way is: "" without text, "bar" or "text"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write the text."""
        self._put(self._plain(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write each of the texts."""
        for line in lines:
            self.write(line)

    def _put(self, text: str) -> None:
        self._stream.write(text)

    def _plain(self, text: str) -> str:
        is_bar = self._line != "text" and self._has_bars()
        if is_bar and self._line == "bar" and CURSOR_UP.fullmatch(text):
            return text
        start = "\r" if is_bar and text.startswith("\r") else ""
        plain = start + printable(text[len(start) :], keep=LINES)
        if plain.endswith("\n"):
            self._line = ""
        elif plain:
            self._line = "bar" if start or (self._line == "bar" and "\n" not in plain) else "text"
        return plain

    def _has_bars(self) -> bool:
        try:
            return self._stream.isatty()
        except ValueError:  # it is closed
            return False
