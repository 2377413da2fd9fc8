"""The figure of Mortar Mayhem and Mystery Path: how it moves and looks. Needs pygame-ce.

Sizes and colours: https://github.com/MarcoMeter/endless-memory-gym/blob/a94f2b6/memory_gym/
character_controller.py (MIT), at a quarter of its scale. Drawn onto surfaces of its own: the original shares
one display per process, so that closing any environment breaks the others.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np
import pygame
from numpy.typing import NDArray

SCREEN_PX, RADIUS_PX, SPEED_PX = 84, 6, 3
SPRITE_PX, HAND_RADIUS_PX = 28, 2
HANDS = ((10, 10), (18, 10))
BODY, OUTLINE, TRANSPARENT = (250, 204, 153), (50, 50, 50), (0, 0, 255)
FACING = {
    (0, -1): 0,
    (-1, -1): 1,
    (-1, 0): 2,
    (-1, 1): 3,
    (0, 1): 4,
    (1, 1): 5,
    (1, 0): 6,
    (1, -1): 7,
}
"""Direction of a move -> sprite, in eighths of a turn, counterclockwise from up."""
SIGNS = (0, -1, 1)  # of an action: none, left or up, right or down


@functools.cache
def sprites() -> tuple[pygame.Surface, ...]:
    """Return the figure in eight directions."""
    return tuple(_sprite(eighths) for eighths in range(len(FACING)))


def _sprite(eighths: int) -> pygame.Surface:
    surface = pygame.Surface((SPRITE_PX, SPRITE_PX))
    surface.fill(TRANSPARENT)
    surface.set_colorkey(TRANSPARENT)
    centre = pygame.math.Vector2(SPRITE_PX // 2, SPRITE_PX // 2)
    pygame.draw.circle(surface, BODY, centre, RADIUS_PX)
    for hand in HANDS:
        place = (pygame.math.Vector2(hand) - centre).rotate(360 - 45 * eighths) + centre
        # At this scale the outline of a hand fills it.
        pygame.draw.circle(surface, OUTLINE, place, HAND_RADIUS_PX)
    return surface


class Walker:
    """The figure: its centre in pixels, where it looks, the square in which it has to stay."""

    def __init__(self, centre: tuple[int, int], *, low_px: int, high_px: int) -> None:
        self.centre = centre
        self.facing = 0
        self._low, self._high = low_px, high_px

    def move(self, action: Sequence[int]) -> None:
        """Move by one action, horizontal and vertical: 0 none, 1 left or up, 2 right or down."""
        dx, dy = SIGNS[action[0]], SIGNS[action[1]]
        if (dx, dy) == (0, 0):
            return
        self.facing = FACING[dx, dy]
        speed = int(SPEED_PX / math.hypot(dx, dy))
        x, y = self.centre[0] + speed * dx, self.centre[1] + speed * dy
        self.centre = self._inside(x), self._inside(y)

    def draw(self, screen: pygame.Surface) -> None:
        """Draw it."""
        surface = sprites()[self.facing]
        screen.blit(surface, surface.get_rect(center=self.centre))

    def _inside(self, number: int) -> int:
        return min(max(number, self._low + RADIUS_PX), self._high - RADIUS_PX)


def pixels(screen: pygame.Surface) -> NDArray[np.uint8]:
    """Return (x, y, 3) uint8, as the originals observe it."""
    return np.ascontiguousarray(pygame.surfarray.array3d(screen), np.uint8)
