"""Turn a matplotlib figure into SVG for use inside a page: its colors are variables, its ids inlined."""

import io
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from xml.etree import ElementTree

import matplotlib
import matplotlib.style
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

# Variables of page.css with their light values: a color of a figure is replaced by the variable.
PALETTE: Mapping[str, str] = {
    "c0": "#0072b2",
    "c1": "#d55e00",
    "c2": "#009e73",
    "c3": "#cc79a7",
    "c4": "#e69f00",
    "c5": "#56b4e9",
    "ink": "#1b1d21",
    "muted": "#5a606b",
    "rule": "#d9dce1",
    "paper": "#ffffff",
}
_VARIABLES = {color: f"var(--{name})" for name, color in PALETTE.items()}
PNG_DPI = 144  # of drawings that are files
GROUPS = frozenset({"whisker", "marker", "curve", "chance", "ceiling"})
"""Ids that artists of a figure may have (`gid`); the page has them as classes."""
FONT_SIZE_PX = 12
_RC = {
    "svg.fonttype": "none",  # text stays text: a tenth of the size, and in the reader's font
    "svg.hashsalt": "vla_eval",  # the same figure gives the same bytes
    "text.parse_math": False,  # a name with two dollar signs is not a formula
    "font.size": FONT_SIZE_PX,
    "figure.dpi": 72,  # a point is a pixel
    "text.color": PALETTE["ink"],
    "axes.labelcolor": PALETTE["ink"],
    "xtick.labelcolor": PALETTE["ink"],
    "ytick.labelcolor": PALETTE["ink"],
    "xtick.bottom": False,
    "ytick.left": False,
    "xtick.major.pad": 6,
    "ytick.major.pad": 6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALETTE["rule"],
    "grid.linewidth": 1,
    "lines.linewidth": 2,
    "lines.scale_dashes": False,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
}
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))
_NUMBER = re.compile(r"-?\d+\.\d+")


def own_style() -> AbstractContextManager[None]:
    """Return a context with our style for making and drawing figures, regardless of matplotlibrc."""
    return matplotlib.style.context(_RC, after_reset=True)


def text_width_px(text: str) -> float:
    """Return the width of a label in matplotlib's font, which is wider than those of most systems."""
    font = FontProperties(size=FONT_SIZE_PX)
    with _missing_glyphs_allowed():
        return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0])


def inline_svg(figure: Figure, *, label: str | None, css_class: str | None = None) -> Markup:
    """Return a figure, drawn within `own_style`, as an `svg` element; without a label: a decoration."""
    file = io.StringIO()
    with _missing_glyphs_allowed():
        figure.savefig(file, format="svg", metadata=_NO_METADATA)
    drawn = ElementTree.fromstring(file.getvalue())
    shapes = {node.attrib["id"]: node for node in drawn.iterfind(".//{*}defs/{*}path")}
    width, height = (round(inches * 72) for inches in figure.get_size_inches())
    size = {"viewBox": f"0 0 {width} {height}", "width": str(width), "height": str(height)}
    role = {"aria-hidden": "true"} if label is None else {"role": "img", "aria-label": label}
    named = {} if css_class is None else {"class": css_class}
    inline = ElementTree.Element("svg", {**size, **role, **named})
    inline.extend(_parts(drawn, shapes))
    return Markup(ElementTree.tostring(inline, encoding="unicode"))


def _parts(
    node: ElementTree.Element, shapes: Mapping[str, ElementTree.Element]
) -> Iterator[ElementTree.Element]:
    """Yield the drawn content of an element, without ids, definitions and empty layers."""
    for child in node:
        tag = child.tag.rpartition("}")[2]
        if tag == "g":
            name = child.get("id")
            if name in GROUPS:
                group = ElementTree.Element("g", {"class": name})
                group.extend(_parts(child, shapes))
                yield group
            else:
                yield from _parts(child, shapes)
        elif tag == "use":
            yield _used(child, shapes)
        elif tag in ("path", "text"):
            yield _drawn(child, tag)


def _drawn(node: ElementTree.Element, tag: str) -> ElementTree.Element:
    kept = {name: _rounded(value) for name, value in node.attrib.items() if name in ("d", "x", "y")}
    element = ElementTree.Element(tag, {**kept, "style": _style(node)})
    element.text = node.text
    return element


def _used(node: ElementTree.Element, shapes: Mapping[str, ElementTree.Element]) -> ElementTree.Element:
    """Return a copy of the referenced shape, at the place of the reference."""
    href = next(value for name, value in node.attrib.items() if name.endswith("href"))
    shape = _drawn(shapes[href.removeprefix("#")], "path")
    shape.set("transform", f"translate({_rounded(node.attrib['x'])} {_rounded(node.attrib['y'])})")
    shape.set("style", f"{_style(node)};{shape.get('style')}")  # the shape's own style wins, as in SVG
    return shape


def _style(node: ElementTree.Element) -> str:
    """Return a style with the page's variables for colors; the font is that of the page."""
    pairs = (part.strip() for part in node.get("style", "").split(";"))
    kept = ";".join(part for part in pairs if part and not part.startswith("font"))
    return re.sub(r"#[0-9a-f]{6}", lambda found: _VARIABLES[found[0]], kept)


def _rounded(numbers: str) -> str:
    """Return coordinates with two decimals: a hundredth of a pixel."""
    return " ".join(_NUMBER.sub(lambda found: f"{float(found[0]):.2f}", numbers).split())


def _missing_glyphs_allowed() -> AbstractContextManager[None]:
    """Return a context without matplotlib's warnings about glyphs: the browser has its own fonts."""
    return warnings.catch_warnings(action="ignore", category=UserWarning)
