"""One image of a few episodes: what the cameras saw in each phase. Numpy and Pillow only."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from vla_eval.core import ImageArray

MARGIN_PX = 4
LABEL_PX = 14
LEFT_PX = 86  # for the episodes' names
BACKGROUND, INK = (255, 255, 255), (30, 30, 30)


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetRow:
    """One episode of the sheet: a name of at most two lines, and (H, W, 3) uint8 frames."""

    name: str
    frames: tuple[ImageArray, ...]


def contact_sheet(columns: Sequence[str], rows: Sequence[SheetRow]) -> bytes:
    """Return a PNG file of all rows below each other; the same input gives the same bytes.

    Args:
        columns: what stands above the frames; as many as each row has.
        rows: the episodes; all frames have one size.
    """
    height, width = rows[0].frames[0].shape[:2]
    sheet = np.full(
        (
            LABEL_PX + len(rows) * (height + MARGIN_PX) + MARGIN_PX,
            LEFT_PX + len(columns) * (width + MARGIN_PX) + MARGIN_PX,
            3,
        ),
        BACKGROUND,
        dtype=np.uint8,
    )
    for i, row in enumerate(rows):
        top = LABEL_PX + i * (height + MARGIN_PX)
        for j, frame in enumerate(row.frames):
            left = LEFT_PX + j * (width + MARGIN_PX)
            sheet[top : top + height, left : left + width] = frame
    picture = Image.fromarray(sheet)
    draw = ImageDraw.Draw(picture)
    for j, label in enumerate(columns):
        draw.text((LEFT_PX + j * (width + MARGIN_PX), 1), label, fill=INK)
    for i, row in enumerate(rows):
        draw.text((MARGIN_PX, LABEL_PX + i * (height + MARGIN_PX)), row.name, fill=INK)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
