"""Escape text for LaTeX and write its tables. Knows nothing of results."""

import re
from collections.abc import Sequence

from vla_eval.plain_text import printable

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "_": r"\_",
        "%": r"\%",
        "&": r"\&",
        "#": r"\#",
        "$": r"\$",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"$<$",
        ">": r"$>$",
        "±": r"$\pm$",
        "×": r"$\times$",
        "†": r"$^\dagger$",
        "‡": r"$^\ddagger$",
        "π": r"$\pi$",
        "μ": r"$\mu$",
        "—": "---",
        "“": "``",
        "”": "''",
    }
)


def latex_table(
    titles: Sequence[str],
    rows: Sequence[Sequence[str]],
    is_number: Sequence[bool],
    *,
    ruled_by_first: bool = False,
) -> list[str]:
    """Return the lines of a `tabular`, which needs booktabs; with rules where the first cell changes."""
    lines = [f"\\begin{{tabular}}{{{''.join('r' if number else 'l' for number in is_number)}}}", "\\toprule"]
    lines += [latex_row(titles), "\\midrule"]
    for above, row in zip((None, *rows), rows, strict=False):
        if ruled_by_first and above is not None and above[0] != row[0]:
            lines.append("\\midrule")
        lines.append(latex_row(row))
    return [*lines, "\\bottomrule", "\\end{tabular}"]


NEEDS = "% needs \\usepackage{booktabs,graphicx}"
"""The first line of a file with a table that is `fitted`."""


def fitted(lines: Sequence[str]) -> list[str]:
    r"""Return a table that is scaled down to `\linewidth` where it is wider; needs booktabs and graphicx."""
    scale = "\\noindent\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%"
    return [scale, *lines, "}"]


def latex_row(cells: Sequence[str]) -> str:
    """Return one row of names and numbers."""
    first, *others = cells
    parts = [latex_first(first), *(re.sub("^-(?=[0-9])", "$-$", latex_text(cell)) for cell in others)]
    return f"{' & '.join(parts)} \\\\"


def latex_first(cell: str) -> str:
    """Return the first cell of a row; the rule or row above would read a bracket or a star as its own."""
    text = re.sub("^-(?=[0-9])", "$-$", latex_text(cell))
    return f"{{}}{text}" if text.startswith(("[", "*")) else text


def latex_text(text: str) -> str:
    """Return text for LaTeX: its own characters escaped, names in backticks as code."""
    parts = [part.translate(_LATEX) for part in re.split("`([^`]*)`", printable(text))]
    return "".join(f"\\texttt{{{part}}}" if i % 2 else part for i, part in enumerate(parts))
