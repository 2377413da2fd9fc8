"""Observations for checks: noise in which two episodes differ in whatever a policy may read of them.

An episode looks one of four ways at each step: warm or cold, left or right. Of the seeds 0 to 3 each looks
another way at the same step, and each looks all four ways in turn: so whatever a policy computes of them,
also if only a yes or no is left of it, differs between some two.

This file runs with Python 3.8 and numpy 1.22, with the file next to it: see `mikasa_vla_client`.
"""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np

from .numbers import unit_vectors  # relative: the file is in two packages

SEEDS = (0, 1, 2, 3)
ROWS = (0, 1, 1, 0)  # of these: an evaluation gives an episode its slot, and its row of a batch, by its seed
PAIRS = ((0, 1), (2, 0), (3, 1))  # side by side: they connect all of them, so not all can be alike in pairs
LOOKS = (0, 1, 3, 2)  # the order in which an episode looks so: bit 0 is cold or warm, bit 1 is left or right
LEVELS = (190, 110, 50)  # of red, green and blue where it is warm; the other way round where it is cold
PATCH_LEVEL, NOISE_LEVEL, DARKER = 60, 20, 40
N_STEPS = 16  # an episode of a check is at least this long: longer than one chunk, and than a short memory


def look_at(seed: int, step: int, chunk_size: int) -> int:
    """Return how an episode looks: another way in the next frame, and at the next inference."""
    return (seed ^ LOOKS[(step // chunk_size + step % chunk_size) % len(LOOKS)]) % len(LOOKS)


def n_inferences(chunk_size: int) -> int:
    """Return how many inferences an episode of a check has: at least 3."""
    return max(3, -(-N_STEPS // chunk_size))


def noise_image(
    generator: np.random.Generator, look: int, height_px: int, width_px: int
) -> np.ndarray[Any, Any]:
    """Return an image (height_px, width_px, 3) uint8."""
    is_warm, is_right = bool(look & 1), bool(look & 2)
    levels = np.array(LEVELS if is_warm else LEVELS[::-1]) - DARKER * is_right
    image = np.broadcast_to(levels, (height_px, width_px, 3)).copy()
    half = slice(height_px // 2, None), slice(width_px // 2, None)
    image[half if is_right else (slice(0, height_px // 2), slice(0, width_px // 2))] += PATCH_LEVEL
    image += generator.integers(-NOISE_LEVEL, NOISE_LEVEL + 1, image.shape)
    return image.clip(0, 255).astype(np.uint8)


def noise_state(generator: np.random.Generator, look: int, names: Sequence[str]) -> np.ndarray[Any, Any]:
    """Return a state, (len(names),) float32 in [-1, 1], with rotations of length 1.

    The signs of its numbers are those of `look`: of every second number by one of its bits.
    """
    signs = np.where([look >> (place % 2) & 1 for place in range(len(names))], 1, -1)
    state: np.ndarray[Any, Any] = (generator.uniform(0.1, 1, len(names)) * signs).astype(np.float32)
    for _, places in unit_vectors(names):
        state[places] /= np.linalg.norm(state[places])
    return state
