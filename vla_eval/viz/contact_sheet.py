"""One image of a few episodes, a row of frames each. Numpy and Pillow only."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from vla_eval.core import ImageArray

MARGIN_PX = 8
LABEL_PX = 14
LEFT_PX = 86  # for the episodes' names
EDGE_PX = 3
BACKGROUND, INK = (255, 255, 255), (30, 30, 30)

Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetRow:
    """One episode: a few short lines next to its frames, all of one size, each in an edge if it has one."""

    name: str
    frames: tuple[ImageArray, ...]
    edge: Rgb | None = None


def contact_sheet(columns: Sequence[str], rows: Sequence[SheetRow], *, title: Sequence[str] = ()) -> bytes:
    """Return a PNG file of the titled columns and rows; the same input gives the same bytes."""
    height, width = rows[0].frames[0].shape[:2]
    first_top = LABEL_PX * (len(title) + 1) + EDGE_PX + MARGIN_PX
    sheet = np.full(
        (
            first_top + len(rows) * (height + MARGIN_PX) + MARGIN_PX,
            LEFT_PX + len(columns) * (width + MARGIN_PX) + MARGIN_PX,
            3,
        ),
        BACKGROUND,
        dtype=np.uint8,
    )
    for i, row in enumerate(rows):
        top = first_top + i * (height + MARGIN_PX)
        for j, frame in enumerate(row.frames):
            left = LEFT_PX + j * (width + MARGIN_PX)
            if row.edge is not None:
                sheet[top - EDGE_PX : top + height + EDGE_PX, left - EDGE_PX : left + width + EDGE_PX] = (
                    row.edge
                )
            sheet[top : top + height, left : left + width] = frame
    canvas = Image.fromarray(sheet)
    draw = ImageDraw.Draw(canvas)
    for i, line in enumerate(title):
        draw.text((MARGIN_PX, 1 + i * LABEL_PX), line, fill=INK)
    for j, label in enumerate(columns):
        draw.text((LEFT_PX + j * (width + MARGIN_PX), 1 + len(title) * LABEL_PX), label, fill=INK)
    for i, row in enumerate(rows):
        draw.text((MARGIN_PX, first_top + i * (height + MARGIN_PX)), row.name, fill=INK)
    buffer = io.BytesIO()
    canvas.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
