"""Images in the size that a server wants. Knows nothing of servers."""

from typing import Literal

import numpy as np
from PIL import Image

from vla_eval.core import ImageArray

Resize = Literal["pad", "plain"]


def resized(image: ImageArray, *, height_px: int, width_px: int, how: Resize) -> ImageArray:
    """Return an image (H, W, 3) uint8 of another size, interpolated bilinearly; itself if it has that size.

    `pad` keeps the proportions and fills with black, the image in the middle; `plain` does not.

    Source of `pad` (the method): https://github.com/Physical-Intelligence/openpi/blob/15a9616a00943ada6c20a0f158e3adb39df2ccac/packages/openpi-client/src/openpi_client/image_tools.py
    """
    height, width = image.shape[:2]
    if (height, width) == (height_px, width_px):
        return image
    if how == "plain":
        return _scaled(image, height_px, width_px)
    ratio = max(width / width_px, height / height_px)
    inner_height, inner_width = max(1, int(height / ratio)), max(1, int(width / ratio))
    top, left = (height_px - inner_height) // 2, (width_px - inner_width) // 2
    padded = np.zeros((height_px, width_px, 3), dtype=np.uint8)
    inner = _scaled(image, inner_height, inner_width)
    padded[top : top + inner_height, left : left + inner_width] = inner
    return padded


def _scaled(image: ImageArray, height_px: int, width_px: int) -> ImageArray:
    scaled = Image.fromarray(image).resize((width_px, height_px), resample=Image.Resampling.BILINEAR)
    return np.asarray(scaled, dtype=np.uint8)
