"""What a linear probe is given of small frames: their pixels, their colours, or colours by place.

Pixels tell what lies at a fixed place. Colours are counted wherever they are, so they tell which things are
in view; colours by place tell where things of a colour are. Pure functions of frames and their background.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.uint8]  # (N, T, px, px, 3): episodes, control steps
Features = NDArray[np.float32]  # (N, T, D)
Background = NDArray[np.float32]  # (px, px, 3)

LEVELS = 5  # of each of red, green and blue
BLOCKS = 8  # per side of an image
DIFFERS = 40  # sum over red, green and blue, of 765: what differs less from the background is background
GREY_SATURATION = 0.3  # below, a pixel is dark, middle or light; above, it has one of six hues
LIGHTNESS = (0.35, 0.7)  # between dark, middle and light
N_HUES = 6


def background(frames: Frames) -> Background:
    """Return the median over episodes and control steps."""
    median: Background = np.median(frames.reshape(-1, *frames.shape[2:]), axis=0).astype(np.float32)
    return median


def pixels(frames: Frames, _behind: Background) -> Features:
    """Return every number of each frame."""
    flat: Features = frames.reshape(*frames.shape[:2], -1).astype(np.float32)
    return flat


def colours(frames: Frames, behind: Background) -> Features:
    """Return how many pixels of the foreground have each of 125 colours: square roots (Hellinger)."""
    level = frames.astype(np.int64) * LEVELS // 256
    colour = (level[..., 0] * LEVELS + level[..., 1]) * LEVELS + level[..., 2]
    return _counts(colour, LEVELS**3, _foreground(frames, behind))


def places(frames: Frames, behind: Background) -> Features:
    """Return how many pixels of the foreground have each of nine colours in each of 8 x 8 blocks."""
    side = frames.shape[2]
    block = np.arange(side) * BLOCKS // side
    cell = block[:, None] * BLOCKS + block[None, :]
    return _counts(_hue(frames) * BLOCKS**2 + cell, (N_HUES + 3) * BLOCKS**2, _foreground(frames, behind))


READINGS: Mapping[str, Callable[[Frames, Background], Features]] = {
    "pixels": pixels,
    "colours": colours,
    "places": places,
}


def _foreground(frames: Frames, behind: Background) -> NDArray[np.bool_]:
    """Return (N, T, px, px), where a frame differs from the background."""
    away = np.abs(frames.astype(np.float32) - behind).sum(axis=-1)
    differs: NDArray[np.bool_] = away > DIFFERS
    return differs


def _hue(frames: Frames) -> NDArray[np.int64]:
    """Return (N, T, px, px): one of six hues, or 6, 7, 8 for dark, middle and light grey."""
    red, green, blue = np.moveaxis(frames.astype(np.float32) / 255, -1, 0)
    high, low = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    spread = np.maximum(high - low, 1e-6)
    sextant = np.select(
        [high == red, high == green],
        [(green - blue) / spread % N_HUES, (blue - red) / spread + 2],
        (red - green) / spread + 4,
    )
    hue = np.minimum(sextant, N_HUES - 1).astype(np.int64)
    grey = N_HUES + np.digitize(high, LIGHTNESS)
    return np.where((high - low) / np.maximum(high, 1e-3) < GREY_SATURATION, grey, hue)


def _counts(bins: NDArray[np.int64], n_bins: int, counted: NDArray[np.bool_]) -> Features:
    """Return (N, T, n_bins), the square root of the number of counted pixels in each bin."""
    n_episodes, n_steps = bins.shape[:2]
    frame = np.arange(n_episodes * n_steps).reshape(n_episodes, n_steps, 1, 1)
    flat = np.broadcast_to(frame * n_bins + bins, bins.shape)[counted]
    found = np.bincount(flat, minlength=n_episodes * n_steps * n_bins)
    roots: Features = np.sqrt(found.reshape(n_episodes, n_steps, n_bins)).astype(np.float32)
    return roots
