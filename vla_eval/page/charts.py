"""Draw inline SVG: estimates with intervals, and curves. Knows nothing of runs or policies.

Colours are classes (`c0`, `c1` …) that the style sheet defines for light, dark and paper. No chart tells
series apart by colour alone: each has a marker or a dash pattern of its own, and its name in words.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from vla_eval.page.markup import Markup, element

N_COLORS = 7
MARKERS = ("circle", "square", "triangle", "diamond", "cross", "down", "bar")
DASHES = (None, "6 3", "2 3", "8 3 2 3", "1 2", "10 4", "4 2 1 2")
RADIUS = 4.0
ROW_HEIGHT = 24.0
CHAR_WIDTH = 6.6  # of the 12 px font of labels, on average

LineKind = Literal["solid", "chance", "ceiling"]


class Point(NamedTuple):
    """A point; `low` and `high` are its interval, if it has one."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Points that belong together.

    Attributes:
        name: in words.
        color: number of the colour and of the marker.
        points: in order of x.
        kind: `chance` and `ceiling` are lines of reference, without markers.
        is_step: y stays as it is until the next x.
    """

    name: str
    color: int
    points: tuple[Point, ...]
    kind: LineKind = "solid"
    is_step: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One line of a forest plot: a rate in [0, 1], its interval, and what it has to be seen against."""

    label: str
    color: int
    value: float | None
    low: float | None
    high: float | None
    chance: float | None
    ceiling: float | None


def forest(bars: Sequence[Bar], *, title: str, description: str) -> Markup:
    """Draw rates with intervals, one below the other, chance and ceiling as ticks.

    Args:
        bars: from the top; a rate of None is said in words.
        title: of the plot, for those who do not see it.
        description: what it shows, likewise.
    """
    left = 16 + CHAR_WIDTH * max(len(bar.label) for bar in bars)
    width, height = left + 420, ROW_HEIGHT * len(bars) + 34

    def x_of(rate: float) -> float:
        return left + rate * 400

    parts = []
    bottom = ROW_HEIGHT * len(bars) + 6
    for tick in (0, 0.25, 0.5, 0.75, 1):
        parts.append(element("line", x1=x_of(tick), x2=x_of(tick), y1=4, y2=bottom, class_="grid"))
        parts.append(_label(f"{tick:g}", x_of(tick), bottom + 16, anchor="middle"))
    for index, bar in enumerate(bars):
        y = ROW_HEIGHT * (index + 0.5) + 4
        parts.append(_label(bar.label, left - 10, y + 4, anchor="end"))
        for rate, kind in ((bar.chance, "chance"), (bar.ceiling, "ceiling")):
            if rate is not None:
                parts.append(
                    element("line", x1=x_of(rate), x2=x_of(rate), y1=y - 9, y2=y + 9, class_=f"mark {kind}")
                )
        if bar.value is None:
            parts.append(_label("no result", x_of(0) + 6, y + 4, anchor="start"))
            continue
        if bar.low is not None and bar.high is not None:
            parts.append(_whisker(bar.color, x1=x_of(bar.low), x2=x_of(bar.high), y1=y, y2=y))
        parts.append(_marker(bar.color, x_of(bar.value), y))
    return _svg(parts, width=width, height=height, title=title, description=description)


def curves(
    series: Sequence[Series], *, title: str, description: str, x_title: str, x_ticks: Sequence[float]
) -> Markup:
    """Draw rates in [0, 1] over a number, one line per series.

    Args:
        series: at least one point in all.
        title: of the plot, for those who do not see it.
        description: what it shows, likewise.
        x_title: what x is, with its unit.
        x_ticks: in increasing order; the first and the last are the ends of the axis.
    """
    left, top, width, height, first, last = 40.0, 10.0, 320.0, 180.0, x_ticks[0], x_ticks[-1]

    def x_of(value: float) -> float:
        return left + 10 + (value - first) / ((last - first) or 1) * (width - 20)

    def y_of(rate: float) -> float:
        return top + (1 - rate) * height

    parts = []
    for tick in (0, 0.25, 0.5, 0.75, 1):
        parts.append(element("line", x1=left, x2=left + width, y1=y_of(tick), y2=y_of(tick), class_="grid"))
        parts.append(_label(f"{tick:g}", left - 6, y_of(tick) + 4, anchor="end"))
    for value in x_ticks:
        parts.append(_label(f"{value:g}", x_of(value), top + height + 18, anchor="middle"))
    parts.append(_label(x_title, left + width / 2, top + height + 36, anchor="middle"))
    for one in sorted(series, key=lambda each: each.kind == "solid"):  # lines of reference behind
        placed = [p._replace(x=x_of(p.x), y=y_of(p.y)) for p in one.points]
        parts.append(_line(one, placed))
        if one.kind != "solid" or one.is_step:
            continue
        for point in placed:
            if point.low is not None and point.high is not None:
                low, high = y_of(point.low), y_of(point.high)
                parts.append(_whisker(one.color, x1=point.x, x2=point.x, y1=low, y2=high))
            parts.append(_marker(one.color, point.x, point.y))
    return _svg(
        parts, width=left + width + 10, height=top + height + 44, title=title, description=description
    )


def legend(names: Sequence[tuple[str, int]], *, lines: bool = False, references: bool = True) -> Markup:
    """Return what colour, marker or dash stands for what.

    Args:
        names: name and number of the colour.
        lines: show dash patterns instead of markers.
        references: also explain the lines of chance and ceiling.
    """
    items = []
    for name, color in names:
        sign = (
            element(
                "line",
                x1=1,
                x2=25,
                y1=8,
                y2=8,
                class_=f"curve c{color % N_COLORS}",
                stroke_dasharray=DASHES[color % N_COLORS],
            )
            if lines
            else _marker(color, 13, 8)
        )
        items.append(element("li", _sign(sign), name))
    for name in ("chance", "ceiling") if references else ():
        items.append(
            element("li", _sign(element("line", x1=1, x2=25, y1=8, y2=8, class_=f"curve {name}")), name)
        )
    return element("ul", *items, class_="legend")


def _sign(content: Markup) -> Markup:
    return element("svg", content, width=26, height=16, aria_hidden="true")


def _svg(parts: Sequence[str], *, width: float, height: float, title: str, description: str) -> Markup:
    picture = element(
        "svg",
        *parts,
        viewBox=f"0 0 {width:.0f} {height:.0f}",
        width=round(width),
        height=round(height),
        role="img",
        aria_label=f"{title}. {description}",
    )
    return element("figure", element("figcaption", title), picture)


def _label(text: str, x: float, y: float, *, anchor: str) -> Markup:
    return element("text", text, x=x, y=y, text_anchor=anchor)


def _whisker(color: int, **ends: float) -> Markup:
    return element("line", **ends, class_=f"whisker c{color % N_COLORS}")


def _line(series: Series, placed: Sequence[Point]) -> Markup:
    corners = [(p.x, p.y) for p in placed]
    if series.is_step:
        corners = [
            corner
            for before, point in zip((placed[0], *placed), placed, strict=False)
            for corner in ((point.x, before.y), (point.x, point.y))
        ]
    style = f"curve c{series.color % N_COLORS}" if series.kind == "solid" else f"curve {series.kind}"
    dash = DASHES[series.color % N_COLORS] if series.kind == "solid" else None
    return element(
        "polyline",
        points=" ".join(f"{x:.1f},{y:.1f}" for x, y in corners),
        class_=style,
        stroke_dasharray=dash,
    )


def _marker(color: int, x: float, y: float) -> Markup:
    style, r = f"marker c{color % N_COLORS}", RADIUS
    shape = MARKERS[color % N_COLORS]
    if shape == "circle":
        return element("circle", cx=x, cy=y, r=r, class_=style)
    outline = {
        "square": ((-r, -r), (r, -r), (r, r), (-r, r)),
        "triangle": ((0, -1.2 * r), (1.2 * r, r), (-1.2 * r, r)),
        "down": ((0, 1.2 * r), (1.2 * r, -r), (-1.2 * r, -r)),
        "diamond": ((0, -1.4 * r), (1.4 * r, 0), (0, 1.4 * r), (-1.4 * r, 0)),
        "bar": ((-1.4 * r, -0.6 * r), (1.4 * r, -0.6 * r), (1.4 * r, 0.6 * r), (-1.4 * r, 0.6 * r)),
        "cross": (
            *((-r, -1.5 * r), (0, -0.5 * r), (r, -1.5 * r), (1.5 * r, -r), (0.5 * r, 0), (1.5 * r, r)),
            *((r, 1.5 * r), (0, 0.5 * r), (-r, 1.5 * r), (-1.5 * r, r), (-0.5 * r, 0), (-1.5 * r, -r)),
        ),
    }[shape]
    path = "M" + "L".join(f"{x + dx:.1f} {y + dy:.1f}" for dx, dy in outline) + "Z"
    return element("path", d=path, class_=style)
