"""Draw rates by two numbers as a heat map, for a page or as a PNG file. Knows nothing of runs or policies."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from vla_eval.page.charts import PX, Chart
from vla_eval.page.svg import PALETTE, PNG_DPI, inline_svg, own_style
from vla_eval.page.tables import DARKEST
from vla_eval.results.own_statistics import rate as rate_text

CELL_PX = (62, 34)
LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX = 52, 10, 8, 44
TITLE_PX = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatMap:
    """Rates in [0, 1] by two numbers, whose titles have the unit; None where nothing is known."""

    title: str
    row_title: str
    column_title: str
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    rates: tuple[tuple[float | None, ...], ...]

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the drawing, without its title."""
        return (
            LEFT_PX + CELL_PX[0] * len(self.columns) + RIGHT_PX,
            TOP_PX + CELL_PX[1] * len(self.rows) + BOTTOM_PX,
        )


def heat_chart(heat: HeatMap) -> Chart:
    """Return a heat map for a page."""
    with own_style():
        width, height = heat.size_px
        figure = Figure(figsize=(width * PX, height * PX), frameon=False)
        _draw(figure, heat, left=0, whole=(width, height))
        described = "; ".join(  # for screen readers
            f"{heat.row_title} {row}, {heat.column_title} {column}: {rate_text(rate)}"
            for row, rates in zip(heat.rows, heat.rates, strict=True)
            for column, rate in zip(heat.columns, rates, strict=True)
        )
        return Chart(heat.title, inline_svg(figure, label=f"{heat.title}. {described}"))


def heat_png(maps: Sequence[HeatMap]) -> bytes:
    """Return one PNG file of heat maps side by side; the same maps give the same bytes."""
    with own_style():
        width = sum(heat.size_px[0] for heat in maps)
        height = max(heat.size_px[1] for heat in maps) + TITLE_PX
        figure = Figure(figsize=(width * PX, height * PX), facecolor=PALETTE["paper"])
        left = 0
        for heat in maps:
            axes = _draw(figure, heat, left=left, whole=(width, height))
            axes.set_title(heat.title, loc="left", fontsize=9, pad=8, color=PALETTE["ink"])
            left += heat.size_px[0]
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=PNG_DPI, metadata={"Software": None})
        return file.getvalue()


def _draw(figure: Figure, heat: HeatMap, *, left: int, whole: tuple[int, int]) -> Axes:
    """Draw into a figure of this size in px, from this x on, at the bottom."""
    n_rows, n_columns = len(heat.rows), len(heat.columns)
    place = (left + LEFT_PX, heat.size_px[1] - TOP_PX - CELL_PX[1] * n_rows)
    size = (CELL_PX[0] * n_columns, CELL_PX[1] * n_rows)
    axes = figure.add_axes((place[0] / whole[0], place[1] / whole[1], size[0] / whole[0], size[1] / whole[1]))
    axes.patch.set_visible(False)
    axes.grid(visible=False)
    axes.set(xlim=(0, n_columns), ylim=(n_rows, 0), xlabel=heat.column_title)
    axes.set_ylabel(heat.row_title, labelpad=8)
    axes.set_xticks([i + 0.5 for i in range(n_columns)], list(map(str, heat.columns)))
    axes.set_yticks([i + 0.5 for i in range(n_rows)], list(map(str, heat.rows)))
    for y, rates in enumerate(heat.rates):
        for x, rate in enumerate(rates):
            if rate:  # nothing to fill where it is 0 or not known
                patch = Rectangle((x, y), 1, 1, facecolor=PALETTE["c0"], alpha=DARKEST * rate, linewidth=0)
                axes.add_patch(patch)
            axes.add_patch(Rectangle((x, y), 1, 1, fill=False, edgecolor=PALETTE["rule"], linewidth=1))
            axes.text(x + 0.5, y + 0.5, rate_text(rate), ha="center", va="center_baseline")
    return axes
