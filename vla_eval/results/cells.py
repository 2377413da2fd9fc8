"""Escape names and notes: no formula, no markup, no second line. Knows nothing of tables."""

import html
import re
from collections.abc import Sequence

from vla_eval.plain_text import printable
from vla_eval.strict.decoding import is_number

FORMULA_SIGNS = ("=", "+", "-", "@", "\t", "\r", "\n")
"""First characters of a cell that a spreadsheet reads as a formula. Source: https://owasp.org/www-community/attacks/CSV_Injection"""

_LINK = re.compile(r"\](?=[(\[:])")  # `[0.4, 0.6]` is not a link
_TAG = re.compile(r"<(?=[A-Za-z/!?])")  # how Markdown finds raw HTML; `p<0.001` is not HTML


def csv_cell(value: object) -> object:
    """Return a value for a row of CSV: text that a spreadsheet would evaluate is prefixed with `'`."""
    if not isinstance(value, str):
        return value
    is_formula = value.startswith(FORMULA_SIGNS) and not (is_number(value) and value == value.strip())
    return f"'{printable(value)}" if is_formula else printable(value)


def markdown_text(text: str) -> str:
    """Return one line of Markdown without HTML, for our own sentences around names."""
    return _TAG.sub("&lt;", printable(text))


def markdown_cell(text: str) -> str:
    """Return a cell of a Markdown table."""
    escaped = markdown_text(text).replace("\\", "\\\\")
    for sign in "|`*":
        escaped = escaped.replace(sign, f"\\{sign}")
    return _LINK.sub(r"\\]", escaped)


def markdown_code(text: str) -> str:
    """Return a code span of Markdown, for a cell too: a text of backticks cannot end it."""
    line = printable(text).replace("|", "\\|")
    fence = "`" * (_longest_run(line) + 1)
    space = " " if "`" in line else ""
    return f"{fence}{space}{line}{space}{fence}"


def markdown_block(text: str, language: str) -> str:
    """Return a fenced block of Markdown that nothing in the text can end."""
    fence = "`" * max(3, _longest_run(text) + 1)
    end = "" if text.endswith("\n") else "\n"
    return f"{fence}{language}\n{text}{end}{fence}"


def html_text(text: str) -> str:
    """Return one line of HTML: escaped, names in backticks as code."""
    parts = [html.escape(part) for part in re.split("`([^`]*)`", printable(text))]
    return "".join(f"<code>{part}</code>" if i % 2 else part for i, part in enumerate(parts))


def html_table(titles: Sequence[str], rows: Sequence[Sequence[str]], is_number: Sequence[bool]) -> str:
    """Return a `table` element without classes or scripts; numbers are aligned to the right."""
    styles = [' style="text-align:right"' if number else "" for number in is_number]

    def line(cells: Sequence[str], tag: str) -> str:
        pairs = zip(styles, map(html.escape, map(printable, cells)), strict=True)
        return f"<tr>{''.join(f'<{tag}{style}>{cell}</{tag}>' for style, cell in pairs)}</tr>"

    body = "\n".join(line(row, "td") for row in rows)
    return f"<table>\n<thead>{line(titles, 'th')}</thead>\n<tbody>\n{body}\n</tbody>\n</table>"


def _longest_run(text: str) -> int:
    return max((len(run) for run in re.findall("`+", text)), default=0)
