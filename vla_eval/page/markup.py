"""Write HTML and SVG so that no text of a run can become markup. Knows nothing of results."""

from collections.abc import Iterable, Sequence
from html import escape

VOID = frozenset({"meta", "img", "br", "line", "rect", "circle", "path", "polyline"})
UNKNOWN = "—"
LONGEST_WORD = 30  # characters: a cell with more is prose, and may be broken into lines


class Markup(str):
    """Text that is markup already; every other string is escaped."""

    __slots__ = ()


def element(tag: str, *children: str, **attributes: object) -> Markup:
    """Return one element.

    Args:
        tag: its name.
        children: markup, or text, which is escaped.
        attributes: `class_` is `class`, `data_row` is `data-row`; None leaves an attribute out, True gives
            one without value.
    """
    texts = []
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        shown = name.rstrip("_").replace("_", "-")
        texts.append(f" {shown}" if value is True else f' {shown}="{escape(_text(value))}"')
    head = f"<{tag}{''.join(texts)}"
    # Within SVG an element that is not closed would swallow those behind it.
    return Markup(f"{head}/>" if tag in VOID else f"{head}>{joined(children)}</{tag}>")


def joined(parts: Iterable[str], separator: str = "") -> Markup:
    """Return markup one after the other; what is plain text is escaped."""
    return Markup(separator.join(part if isinstance(part, Markup) else escape(part) for part in parts))


def with_code(text: str) -> Markup:
    """Return text in which names stand between backticks, as in Markdown, with these set as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # one of them stands alone: it is no mark
        return joined([text])
    return joined(element("code", part) if index % 2 else part for index, part in enumerate(parts))


def table(
    titles: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    numeric: Sequence[bool],
    caption: str | None = None,
    row_data: Sequence[str] | None = None,
) -> Markup:
    """Return a table whose first column names its rows.

    Args:
        titles: of the columns.
        rows: cells, markup or text.
        numeric: which columns are set flush right.
        caption: what the table is, for those who cannot see what surrounds it.
        row_data: for each row what it is made of, as JSON, in the attribute `data-row`.
    """
    classes = ["number" if is_number else None for is_number in numeric]
    head = element(
        "tr", *(element("th", title, scope="col", class_=c) for title, c in zip(titles, classes, strict=True))
    )
    body = []
    for index, row in enumerate(rows):
        first, *others = row
        cells = [element("th", first, scope="row")]
        for cell, style in zip(others, classes[1:], strict=True):
            is_prose = style is None and len(cell) > LONGEST_WORD
            cells.append(element("td", cell, class_="prose" if is_prose else style))
        body.append(element("tr", *cells, data_row=row_data[index] if row_data else None))
    parts = [element("caption", caption)] if caption else []
    whole = element("table", *parts, element("thead", head), element("tbody", *body))
    return element("div", whole, class_="scroll", tabindex=0, role="region", aria_label=caption or "table")


def section(anchor: str, title: str, *children: str) -> Markup:
    """Return a section with a heading that can be linked to."""
    return element("section", element("h2", title), *children, id=anchor)


def paragraph(*children: str, muted: bool = False) -> Markup:
    """Return a paragraph; a muted one explains rather than tells."""
    return element("p", *children, class_="muted" if muted else None)


def details(summary: str, *children: str) -> Markup:
    """Return what is shown when it is asked for, and always in print."""
    return element("details", element("summary", summary), *children)


def _text(value: object) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
