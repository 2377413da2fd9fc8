"""Where objects can lie on the table: places of items, each shifted a little per episode, and ranges.

Knows nothing of the items, of phases or of a simulator.
"""

import math

import numpy as np
from numpy.typing import NDArray

JITTER_STD_M = 0.01
MIN_DISTANCE_M = 0.06
MAX_JITTER_TRIES = 50
MIXED_MIN_DISTANCE_M = 0.061  # a cross is 6 cm wide
# The official arc is compressed in y by this much per place, only for these numbers of items.
SQUEEZE_M = {5: 0.025, 9: 0.025}

ARC_CENTRE_X_M = -0.25  # the places of the official arc lie around (-0.25, 0)

# Cubes that are shown together lie on an arc, compressed in y by this much per place (official constants).
BUNCH_RADIUS_M = 0.22
BUNCH_SQUEEZE_M = 0.015

MUG_SPACING_M = 0.2  # the shell game: three mugs in a row along y
LAYOUT_HALF_RANGE_M = 0.1  # of its centre, in x and y

PEG_RANGE_M = 0.1  # Rotate: the peg's centre is within ± this in x and y

# Intercept: where the ball's centre is at the start, and the disc, so far beyond its lane.
SPAWN_X_M = (-0.35, -0.05)
SPAWN_Y_M = (-0.9, -0.65)
GOAL_OFFSET_X_M = 0.2
DISC_Y_M = (-0.2, 0.2)

# TakeItBack: where the cube can lie at the start, and its goal.
START_X_M = (-0.05, 0.05)
START_BANDS_Y_M = (-0.1, 0.0, 0.1)
START_BAND_WIDTH_M = 0.05  # y is uniform from a band's number on, over this width
GOAL_X_M = (0.2, 0.25)
GOAL_Y_M = (-0.025, 0.025)

Plane = NDArray[np.float64]
"""Positions in the table's plane, (…, 2), m."""


def slot_centres_m(n_items: int) -> Plane:
    """Return (N, 2) xy of the places on the table, world frame, before jitter.

    A row for three items, otherwise an arc around the robot. Source: official task code, constants as
    measured in the task table of `docs/tasks.md`; other numbers of items follow the same rule with the
    compression of five and nine.
    """
    if n_items == 3:
        return np.array([[0.0, 0.1], [0.0, 0.0], [0.0, -0.1]])
    official_without_squeeze = n_items in (6, 15)
    squeeze_m = 0.0 if official_without_squeeze else SQUEEZE_M.get(n_items, 0.025)
    offset = 0.5 if n_items == 6 else 0.0
    ranks = [k - n_items // 2 + offset for k in range(n_items)]
    angles = [math.pi * rank / n_items for rank in ranks]
    return np.array(
        [
            (0.3 * math.cos(angle) + ARC_CENTRE_X_M, 0.3 * math.sin(angle) - squeeze_m * rank)
            for rank, angle in zip(ranks, angles, strict=True)
        ]
    )


def bunch_place_m(color: int, n_colors: int) -> tuple[float, float]:
    """Return the (x, y) of the cube of this colour while cubes are shown together, world frame.

    Source: official task code, constants as measured (`docs/tasks.md`); other numbers of colours follow
    the same rule.
    """
    rank = color - n_colors // 2
    angle = math.pi * rank / n_colors
    return BUNCH_RADIUS_M * math.cos(angle), BUNCH_RADIUS_M * math.sin(angle) - BUNCH_SQUEEZE_M * rank


def places_from_right(positions_m: Plane) -> tuple[int, ...]:
    """Return the place of each object (N, 2), world frame: 0 is the rightmost as the robot sees it.

    Counted by the angle about the centre of the arc: the outermost places of an arc of nine differ by 1 cm
    in y, which is the jitter, but by more than 20 degrees.
    """
    angles = np.arctan2(positions_m[:, 1], positions_m[:, 0] - ARC_CENTRE_X_M)
    order = np.argsort(angles, kind="stable")
    return tuple(int(place) for place in np.argsort(order, kind="stable"))


def jittered(centres_m: Plane, rng: np.random.Generator) -> Plane:
    """Shift each place by N(0, 1 cm) in x and y, one after another, at least 6 cm from earlier ones.

    A place for which `MAX_JITTER_TRIES` draws fail is not shifted, as in the official code.
    """
    placed: list[Plane] = []
    for centre in centres_m:
        for _ in range(MAX_JITTER_TRIES):
            draft = centre + rng.normal(0, JITTER_STD_M, 2)
            if all(np.linalg.norm(draft - other) >= MIN_DISTANCE_M for other in placed):
                break
        else:
            draft = centre
        placed.append(draft)
    return np.stack(placed)


def jittered_apart(centres_m: Plane, rng: np.random.Generator) -> Plane:
    """Shift each place by N(0, 1 cm), at least 6.1 cm from all others, shifted or not yet shifted.

    So no two items ever overlap. The official code shifts all at once and keeps the best of 20 draws. Some
    of its 15 places are then 4.7 cm apart, and items 6 cm wide are pushed away when they are revealed
    (measured: by up to 10 cm).
    """
    places = centres_m.copy()
    for index, centre in enumerate(centres_m):
        others = np.delete(places, index, axis=0)
        for _ in range(MAX_JITTER_TRIES):
            draft = centre + rng.normal(0, JITTER_STD_M, 2)
            if np.linalg.norm(others - draft, axis=1).min() >= MIXED_MIN_DISTANCE_M:
                places[index] = draft
                break
    return places
