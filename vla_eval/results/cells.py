"""Write names and notes so that nothing in them acts: no formula, no markup, no second line.

Knows nothing of tables.
"""

import re

from vla_eval.errors import one_line

FORMULA_SIGNS = ("=", "+", "-", "@", "\t", "\r", "\n")
"""What a spreadsheet takes a cell for a formula by. Source: https://owasp.org/www-community/attacks/CSV_Injection"""

_TAG = re.compile(r"<(?=[A-Za-z/!?])")  # how Markdown finds raw HTML; `p<0.001` is none


def csv_cell(value: object) -> object:
    """Return a value for a row of CSV: text that a spreadsheet would calculate is quoted with `'`."""
    if not isinstance(value, str):
        return value
    is_formula = value.startswith(FORMULA_SIGNS) and not _is_number(value)
    return f"'{one_line(value)}" if is_formula else one_line(value)


def markdown_text(text: str) -> str:
    """Return one line of Markdown in which no HTML begins."""
    return _TAG.sub("&lt;", one_line(text))


def markdown_cell(text: str) -> str:
    """Return a cell of a Markdown table."""
    return markdown_text(text).replace("\\", "\\\\").replace("|", "\\|")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text == text.strip()
