"""Everyday things, as small as the other items: twelve toys from primitives, each with colours of its own.

All are at most 6 cm long, lie or stand at rest, and have their origin in the middle of their height, 3 cm
below their top at most: the arm comes to rest 4 cm above it. Where parts have different radii, their lowest
points are in one plane. No meshes: what touches is what is seen, and nothing has to be shipped.
"""

import math
from collections.abc import Sequence

from vla_eval.tasks.objects.item_names import THING_NAMES
from vla_eval.tasks.objects.items import Z_UP_WXYZ, Primitive, Shape

RGB = tuple[int, int, int]
YELLOW, BROWN, DARK = (250, 205, 40), (110, 70, 35), (40, 40, 45)
ORANGE, STEEL, WHITE = (245, 120, 30), (140, 145, 150), (240, 240, 235)
GLASS, RED, APPLE = (25, 105, 60), (205, 30, 35), (190, 25, 40)
LEAF, CHINA, INK = (60, 150, 50), (110, 160, 215), (45, 60, 150)
TOMATO, SKY, GOLD = (220, 50, 40), (150, 205, 235), (200, 160, 60)
N_WALL = 12  # boxes around something hollow


def _box(x: float, y: float, z: float, rgb: RGB, *, at: tuple[float, float, float] = (0, 0, 0)) -> Primitive:
    """Return a box of these edges, m."""
    return Primitive(kind="box", size=(x / 2, y / 2, z / 2), position_m=at, rgb=rgb)


def _turned(*rings: tuple[float, float, RGB], bottom_m: float) -> tuple[Primitive, ...]:
    """Return upright cylinders (radius, height, colour), one upon the other, m."""
    parts, z = [], bottom_m
    for radius, height, rgb in rings:
        middle = (0.0, 0.0, z + height / 2)
        size = (radius, height / 2)
        parts.append(
            Primitive(kind="cylinder", size=size, position_m=middle, orientation_wxyz=Z_UP_WXYZ, rgb=rgb)
        )
        z += height
    return tuple(parts)


def _wall(radius_m: float, height_m: float, thick_m: float, rgb: RGB, *, z_m: float) -> tuple[Primitive, ...]:
    """Return the boxes of an upright tube of this outer radius, whose middle is at z."""
    parts = []
    for k in range(N_WALL):
        angle = 2 * math.pi * k / N_WALL
        middle = radius_m - thick_m / 2
        parts.append(
            Primitive(
                kind="box",
                size=(thick_m / 2, radius_m * math.tan(math.pi / N_WALL), height_m / 2),
                position_m=(middle * math.cos(angle), middle * math.sin(angle), z_m),
                orientation_wxyz=(math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)),
                rgb=rgb,
            )
        )
    return tuple(parts)


def _arc(
    centre_x_m: float, radius_m: float, tube_m: float, degrees: float, colors: Sequence[RGB]
) -> tuple[Primitive, ...]:
    """Return pieces of a lying tube along an arc about (x, 0), one per colour; middle on the x axis."""
    step = math.radians(degrees) / len(colors)
    parts = []
    for k, rgb in enumerate(colors):
        angle = step * (k + 0.5) - math.radians(degrees) / 2
        along = angle + math.pi / 2
        parts.append(
            Primitive(
                kind="cylinder",
                size=(tube_m, radius_m * math.tan(step / 2)),
                position_m=(centre_x_m + radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0),
                orientation_wxyz=(math.cos(along / 2), 0.0, 0.0, math.sin(along / 2)),
                rgb=rgb,
            )
        )
    return tuple(parts)


def _carrot() -> tuple[Primitive, ...]:
    """Return a lying one: discs along x that become thinner, on one plane, and leaves."""
    radii = (0.009, 0.0085, 0.0075, 0.006, 0.0045, 0.003)
    body = [
        Primitive(
            kind="cylinder",
            size=(radius, 0.0036),
            position_m=(-0.012 + 0.0072 * k, 0.0, radius - radii[0]),
            rgb=ORANGE,
        )
        for k, radius in enumerate(radii)
    ]
    return (*body, _box(0.014, 0.012, 0.006, LEAF, at=(-0.0226, 0.0, -0.006)))


def _car() -> tuple[Primitive, ...]:
    """Return a body with a cabin on four wheels, which do not turn."""
    wheels = [
        Primitive(
            kind="cylinder",
            size=(0.006, 0.0025),
            position_m=(x, y, -0.008),
            orientation_wxyz=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),
            rgb=DARK,
        )
        for x in (-0.016, 0.016)
        for y in (-0.0135, 0.0135)
    ]
    body = _box(0.05, 0.026, 0.012, RED, at=(0, 0, -0.003))
    return (body, _box(0.026, 0.022, 0.011, SKY, at=(-0.003, 0, 0.0085)), *wheels)


_PARTS: dict[str, tuple[float, tuple[Primitive, ...]]] = {
    # name: height of the origin over the table, parts
    "banana": (0.007, _arc(-0.027, 0.03, 0.007, 110, (BROWN, YELLOW, YELLOW, YELLOW, YELLOW, YELLOW, BROWN))),
    "mug": (
        0.016,
        (
            *_wall(0.015, 0.032, 0.003, ORANGE, z_m=0.0),
            *_turned((0.0135, 0.003, ORANGE), bottom_m=-0.016),
            _box(0.01, 0.005, 0.004, ORANGE, at=(0.02, 0.0, 0.009)),
            _box(0.01, 0.005, 0.004, ORANGE, at=(0.02, 0.0, -0.009)),
            _box(0.004, 0.005, 0.022, ORANGE, at=(0.025, 0.0, 0.0)),
        ),
    ),
    "hammer": (
        0.007,
        (
            _box(0.046, 0.008, 0.008, BROWN, at=(0.005, 0.0, -0.003)),
            _box(0.012, 0.03, 0.014, STEEL, at=(-0.02, 0.0, 0.0)),
        ),
    ),
    "bottle": (
        0.029,
        _turned(
            (0.013, 0.034, GLASS), (0.01, 0.005, GLASS), (0.0055, 0.012, GLASS), (0.0065, 0.007, RED),
            bottom_m=-0.029,
        ),
    ),
    "apple": (
        0.018,
        (
            Primitive(kind="sphere", size=(0.018,), rgb=APPLE),
            *_turned((0.0015, 0.008, BROWN), bottom_m=0.017),
            _box(0.016, 0.005, 0.0015, LEAF, at=(0.0, 0.0, 0.021))  # a leaf on one side would tilt it,
        ),
    ),
    "bowl": (
        0.009,
        (*_wall(0.026, 0.018, 0.003, CHINA, z_m=0.0), *_turned((0.0245, 0.003, WHITE), bottom_m=-0.009)),
    ),
    "book": (
        0.007,
        (
            _box(0.034, 0.046, 0.0025, INK, at=(0, 0, 0.00575)),
            _box(0.034, 0.046, 0.0025, INK, at=(0, 0, -0.00575)),
            _box(0.0025, 0.046, 0.009, INK, at=(-0.01575, 0, 0)),
            _box(0.029, 0.042, 0.009, WHITE, at=(0, 0, 0)),
        ),
    ),
    "car": (0.014, _car()),
    "mushroom": (
        0.019,
        _turned(
            (0.009, 0.018, WHITE), (0.02, 0.007, TOMATO), (0.0165, 0.006, TOMATO), (0.01, 0.005, TOMATO),
            bottom_m=-0.019,
        ),
    ),
    "carrot": (0.009, _carrot()),
    "cone": (
        0.024,
        (
            _box(0.036, 0.036, 0.004, DARK, at=(0, 0, -0.022)),
            *_turned(
                (0.013, 0.011, ORANGE), (0.01, 0.011, WHITE), (0.007, 0.011, ORANGE), (0.004, 0.011, WHITE),
                bottom_m=-0.02,
            ),
        ),
    ),
    "key": (
        0.003,
        (
            *_arc(-0.017, 0.009, 0.003, 360, (GOLD,) * 8),
            _box(0.036, 0.006, 0.006, GOLD, at=(0.01, 0, 0)),
            _box(0.004, 0.01, 0.006, GOLD, at=(0.018, 0.007, 0)),
            _box(0.004, 0.008, 0.006, GOLD, at=(0.025, 0.006, 0)),
        ),
    ),
}  # fmt: skip
THINGS = {
    name: Shape(name=name, parts=_PARTS[name][1], rest_height_m=_PARTS[name][0]) for name in THING_NAMES
}
"""In the order of the indices in records: a task with N of them has the first N."""
