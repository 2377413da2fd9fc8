"""Readable frames of games that have none of their own: a board of cells, with lines of text below it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]

PAPER: Color = (246, 244, 238)
INK: Color = (40, 42, 48)
HIDDEN: Color = (120, 126, 140)
SHOWN: Color = (255, 255, 255)
GOOD: Color = (70, 150, 90)
BAD: Color = (200, 80, 70)
MARK: Color = (235, 180, 60)

CELL_PX = 36
LINE_PX = 18
MARGIN_PX = 8
MIN_WIDTH_PX = 256
MAX_BOARD_PX = 512


class Cell(NamedTuple):
    """One cell of a board."""

    text: str = ""
    color: Color = HIDDEN


def board_picture(cells: Sequence[Sequence[Cell]], lines: Sequence[str] = ()) -> NDArray[np.uint8]:
    """Draw rows of cells and, below them, lines of text.

    Returns:
        (H, W, 3) uint8; the same size for boards of the same shape and as many lines.
    """
    columns = max((len(row) for row in cells), default=0)
    cell_px = min(CELL_PX, MAX_BOARD_PX // max(columns, 1))
    width = max(columns * cell_px + 2 * MARGIN_PX, MIN_WIDTH_PX)
    height = len(cells) * cell_px + len(lines) * LINE_PX + 3 * MARGIN_PX
    image = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(max(cell_px // 2, 8))
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            left, top = MARGIN_PX + j * cell_px, MARGIN_PX + i * cell_px
            draw.rectangle((left, top, left + cell_px - 2, top + cell_px - 2), fill=cell.color, outline=INK)
            if cell.text:
                centre = (left + (cell_px - 2) / 2, top + (cell_px - 2) / 2)
                draw.text(centre, cell.text, fill=_readable_on(cell.color), font=font, anchor="mm")
    small = ImageFont.load_default(LINE_PX - 5)
    for k, line in enumerate(lines):
        top = 2 * MARGIN_PX + len(cells) * cell_px + k * LINE_PX
        draw.text((MARGIN_PX, top), line, fill=INK, font=small)
    return np.asarray(image)


Line = tuple[tuple[float, float], tuple[float, float], Color, int]
"""From, to, colour, width in pixels; x from -1.3 to 1.3, y from -1 to 1, up."""


def line_picture(drawn: Sequence[Line], words: Sequence[str] = ()) -> NDArray[np.uint8]:
    """Draw straight lines and, below them, lines of text; (H, W, 3) uint8."""
    width, field = MIN_WIDTH_PX, 200
    image = Image.new("RGB", (width, field + len(words) * LINE_PX + MARGIN_PX), PAPER)
    draw = ImageDraw.Draw(image)

    def pixel(point: tuple[float, float]) -> tuple[float, float]:
        return width * (point[0] / 1.3 + 1) / 2, field * (1 - point[1]) / 2

    for start, end, color, width_px in drawn:
        draw.line((*pixel(start), *pixel(end)), fill=color, width=width_px)
    font = ImageFont.load_default(LINE_PX - 5)
    for k, line in enumerate(words):
        draw.text((MARGIN_PX, field + k * LINE_PX), line, fill=INK, font=font)
    return np.asarray(image)


def enlarged(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Return an (H, W, 3) image with each pixel `factor` times as large."""
    return np.ascontiguousarray(image.repeat(factor, axis=0).repeat(factor, axis=1))


def _readable_on(color: Color) -> Color:
    red, green, blue = color
    return INK if 0.3 * red + 0.59 * green + 0.11 * blue > 128 else SHOWN
