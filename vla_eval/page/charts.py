"""Draw estimates with intervals, and curves, by matplotlib. Knows nothing of runs or policies.

No chart distinguishes series by color alone: each has its own marker or dash pattern, and its name in words.
Only code that builds a page imports this module, as it imports matplotlib.
"""

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vla_eval.page.svg import PALETTE, PNG_DPI, inline_svg, own_style, text_width_px
from vla_eval.plain_text import printable

COLORS = tuple(PALETTE[name] for name in ("c0", "c1", "c2", "c3", "c4", "c5", "ink"))
MARKERS = (("o", 8), ("s", 7.5), ("^", 9), ("D", 7), ("X", 9), ("v", 9), ("P", 9))  # with their sizes, px
DASHES = ((), (6, 3), (2, 3), (8, 3, 2, 3), (8, 3, 2, 3, 2, 3), (10, 4), (4, 2, 1, 2))  # px on, px off
REFERENCES: Mapping[str, tuple[str, tuple[float, ...]]] = MappingProxyType(
    {"chance": (PALETTE["muted"], (5, 3)), "ceiling": (PALETTE["ink"], (1.5, 3))}
)
RATE_TICKS = (0, 0.25, 0.5, 0.75, 1)
PX = 1 / 72  # inches, as matplotlib counts
ROW_HEIGHT_PX = 24
FOREST_WIDTH_PX = 760  # with its labels as wide as the page
NARROW_FOREST_WIDTH_PX = 180  # with its labels it is legible on a phone
CURVES_SIZE_PX = (320, 180)
DODGE = 0.014  # of the axis: points of several series at one x stand side by side
SIGN_SIZE_PX = (26, 16)

LineKind = Literal["solid", "chance", "ceiling"]


class Point(NamedTuple):
    """A point; `low` and `high` are its interval, if it has one."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Points that belong together."""

    name: str
    color: int  # number of the color and of the marker
    points: tuple[Point, ...]  # in order of x
    kind: LineKind = "solid"  # `chance` and `ceiling` are lines of reference, without markers
    is_step: bool = False  # y is constant until the next x


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One line of a forest plot: a rate in [0, 1], its interval, and its reference values."""

    label: str
    color: int
    value: float | None
    low: float | None
    high: float | None
    chance: float | None
    ceiling: float | None


class Chart(NamedTuple):
    """A drawing and its title, which is not part of it; `narrow` is the drawing for a narrow screen."""

    title: str
    svg: Markup
    narrow: Markup | None = None


def forest(
    bars: Sequence[Bar],
    *,
    title: str,
    description: str,
    width_px: float = FOREST_WIDTH_PX,
    label_px: float = 0,
) -> Chart:
    """Draw rates with intervals, one below the other, chance and ceiling as ticks."""
    label = f"{title}. {description}"
    with own_style():
        return Chart(
            title,
            inline_svg(_forest(bars, width_px, label_px), label=label, css_class="wide"),
            inline_svg(_forest(bars, NARROW_FOREST_WIDTH_PX, label_px), label=label, css_class="narrow"),
        )


def labels_width_px(labels: Iterable[str]) -> float:
    """Return the width of the longest label."""
    return max((text_width_px(printable(label)) for label in labels), default=0)


def _forest(bars: Sequence[Bar], width_px: float, label_px: float) -> Figure:
    labels = [printable(bar.label) for bar in bars]
    left = 16 + max(label_px, labels_width_px(labels))
    figure, axes = _plot(width_px, ROW_HEIGHT_PX * len(bars), left=left, right=20, top=4, bottom=26)
    axes.set(xlim=(0, 1), ylim=(len(bars) - 0.5, -0.5))
    axes.set_xticks(RATE_TICKS, [f"{tick:g}" for tick in RATE_TICKS])
    axes.set_yticks(range(len(bars)), labels)
    axes.tick_params(axis="y", pad=10)  # room for a marker at 0
    axes.grid(visible=False, axis="y")
    for y, bar in enumerate(bars):
        for name, rate in (("chance", bar.chance), ("ceiling", bar.ceiling)):
            if rate is not None:
                axes.plot([rate, rate], [y - 0.4, y + 0.4], **_reference_line(name), gid=name)
        if bar.value is None:
            axes.text(0.015, y, "no result", va="center_baseline")
        else:
            if bar.low is not None and bar.high is not None:
                axes.plot([bar.low, bar.high], [y, y], color=_color(bar.color), gid="whisker")
            _marker(axes, bar.color, bar.value, y)
    return figure


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """Rates in [0, 1] over a number, one line per series."""

    series: Sequence[Series]  # at least one point in all
    title: str
    description: str
    x_title: str  # what x is, with its unit
    x_ticks: Sequence[float]  # in increasing order; the first and the last are the ends of the axis
    x_labels: Sequence[str] | None = None  # what is written at each tick, if not its number


def curves(drawn: Curves) -> Chart:
    """Draw curves for a page."""
    with own_style():
        return Chart(drawn.title, inline_svg(_curves(drawn), label=f"{drawn.title}. {drawn.description}"))


def curves_png(drawn: Curves) -> bytes:
    """Return a PNG file of `curves`, on paper, with the names of the series."""
    with own_style():
        figure = _curves(drawn)
        figure.set(frameon=True, facecolor=PALETTE["paper"])
        (axes,) = figure.axes
        named = sorted(drawn.series, key=lambda one: one.kind != "solid")  # lines of reference last
        handles = [Line2D([], [], **_line(one), label=one.name) for one in named]
        # Beside the axes: with several series no corner is free.
        axes.legend(handles=handles, frameon=False, loc="center left", bbox_to_anchor=(1.02, 0.5))
        axes.set_title(printable(drawn.title), pad=10)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=PNG_DPI, bbox_inches="tight", metadata={"Software": None})
        return file.getvalue()


def _curves(drawn: Curves) -> Figure:
    series, x_ticks = drawn.series, drawn.x_ticks
    figure, axes = _plot(*CURVES_SIZE_PX, left=40, right=12, top=10, bottom=44)
    margin = (x_ticks[-1] - x_ticks[0] or 1) * (0.03 + len(series) * DODGE / 2)
    axes.set(xlim=(x_ticks[0] - margin, x_ticks[-1] + margin), ylim=(0, 1), xlabel=drawn.x_title)
    axes.set_xticks(x_ticks, drawn.x_labels or [f"{tick:g}" for tick in x_ticks])
    axes.set_yticks(RATE_TICKS, [f"{tick:g}" for tick in RATE_TICKS])
    axes.grid(visible=False, axis="x")
    for one in _dodged(series, (x_ticks[-1] - x_ticks[0]) * DODGE):
        _draw_series(axes, one)
    return figure


def _dodged(series: Sequence[Series], distance: float) -> list[Series]:
    """Return lines of reference first, which are behind, and points moved apart where series share an x."""
    references = [one for one in series if one.kind != "solid"]
    solid = [one for one in series if one.kind == "solid"]
    moved = []
    for i, one in enumerate(solid):
        shift = 0.0 if one.is_step else (i - (len(solid) - 1) / 2) * distance
        points = tuple(point._replace(x=point.x + shift) for point in one.points)
        moved.append(replace(one, points=points))
    return [*references, *moved]


def sign(color: int, *, is_line: bool) -> Markup:
    """Return the line or marker of a series, for a legend."""
    if is_line:
        return _sign([0.04, 0.96], **_solid_line(color))
    shape, size = MARKERS[color % len(MARKERS)]
    style = {"marker": shape, "markersize": size, "markeredgewidth": 0, "linestyle": "none"}
    return _sign([0.5], color=_color(color), **style)


def reference_sign(name: str) -> Markup:
    """Return the line of `chance` or of `ceiling`."""
    return _sign([0.04, 0.96], **_reference_line(name))


def _sign(xs: Sequence[float], **style: Any) -> Markup:  # Any: matplotlib's properties of a line
    with own_style():
        figure = Figure(figsize=(SIGN_SIZE_PX[0] * PX, SIGN_SIZE_PX[1] * PX), frameon=False)
        figure.add_artist(Line2D(xs, [0.5] * len(xs), **style))
        return inline_svg(figure, label=None)


def _plot(
    width: float, height: float, *, left: float, right: float, top: float, bottom: float
) -> tuple[Figure, Axes]:
    """Return axes of a size in px, with room around them."""
    whole = (left + width + right, top + height + bottom)
    figure = Figure(figsize=(whole[0] * PX, whole[1] * PX), frameon=False)
    axes = figure.add_axes((left / whole[0], bottom / whole[1], width / whole[0], height / whole[1]))
    axes.patch.set_visible(False)
    return figure, axes


def _draw_series(axes: Axes, series: Series) -> None:
    xs, ys = [point.x for point in series.points], [point.y for point in series.points]
    if series.kind != "solid":
        axes.plot(xs, ys, **_line(series), gid=series.kind)
        return
    draw = "steps-post" if series.is_step else "default"
    axes.plot(xs, ys, **_line(series), drawstyle=draw, gid="curve")
    if series.is_step:
        return
    for point in series.points:
        if point.low is not None and point.high is not None:
            ends = [point.low, point.high]
            axes.plot([point.x, point.x], ends, color=_color(series.color), gid="whisker")
        _marker(axes, series.color, point.x, point.y)


def _line(series: Series) -> dict[str, Any]:  # Any: matplotlib's properties of a line
    return _solid_line(series.color) if series.kind == "solid" else _reference_line(series.kind)


def _solid_line(number: int) -> dict[str, Any]:
    return {"color": _color(number), "linestyle": (0, DASHES[number % len(DASHES)] or None)}


def _reference_line(name: str) -> dict[str, Any]:
    color, dashes = REFERENCES[name]
    return {"color": color, "linestyle": (0, dashes)}


def _marker(axes: Axes, color: int, x: float, y: float) -> None:
    shape, size = MARKERS[color % len(MARKERS)]
    axes.plot(
        [x],
        [y],
        color=_color(color),
        linestyle="none",
        marker=shape,
        markersize=size,
        markeredgecolor=PALETTE["paper"],
        markeredgewidth=1,
        clip_on=False,  # a whole marker also at a rate of 0 or 1
        gid="marker",
    )


def _color(number: int) -> str:
    return COLORS[number % len(COLORS)]
