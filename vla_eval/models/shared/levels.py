"""Images as bytes, and as the numbers in [0, 1] that LeRobot's datasets and policies hand over."""

import torch
from torch import Tensor

MAX_LEVEL = 255.0  # of a channel


def in_numbers(images: Tensor) -> Tensor:
    """Return images in [0, 1], given that or bytes. Of bytes it takes a while: leave padding out first."""
    return images.to(torch.float32).div_(MAX_LEVEL) if images.dtype == torch.uint8 else images


def in_bytes(images: Tensor) -> Tensor:
    """Return images as bytes, given that or numbers in [0, 1]."""
    return images if images.dtype == torch.uint8 else images.mul(MAX_LEVEL).round_().to(torch.uint8)
