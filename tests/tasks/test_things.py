"""Everyday things: they fit between their neighbours and under the gripper, rest on the table, and differ."""

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from vla_eval.oracles.hover import CUBES
from vla_eval.tasks.objects.free_places import THING_HEIGHT_M
from vla_eval.tasks.objects.items import Primitive, Shape
from vla_eval.tasks.objects.layout import MIXED_MIN_DISTANCE_M
from vla_eval.tasks.objects.things import THINGS

MM = 1e-3


def turned(points: NDArray[np.float64], wxyz: tuple[float, float, float, float]) -> NDArray[np.float64]:
    w, *vector = wxyz
    axis = np.array(vector)
    cross = np.cross(axis, points)
    return points + 2 * w * cross + 2 * np.cross(axis, cross)


def surface(part: Primitive) -> NDArray[np.float64]:
    """Points on a part's surface, among them the outermost ones, to a hundredth of a radius."""
    if part.kind == "box":
        corners = np.array(list(itertools.product((-1, 1), repeat=3))) * np.array(part.size)
        points = corners
    elif part.kind == "sphere":
        directions = np.random.default_rng(0).normal(size=(4000, 3))
        points = part.size[0] * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        points = np.concatenate([points, part.size[0] * np.array([[0, 0, 1], [0, 0, -1.0]])])
    else:
        radius, half = part.size
        angles = np.linspace(0, 2 * math.pi, 361)
        rim = np.column_stack([np.zeros(361), radius * np.cos(angles), radius * np.sin(angles)])
        ends = half * np.array([[1.0, 0, 0]])
        points = np.concatenate([rim + ends, rim - ends])
    return turned(points, part.orientation_wxyz) + np.array(part.position_m)


def points_of(thing: Shape) -> NDArray[np.float64]:
    return np.concatenate([surface(part) for part in thing.parts])


@pytest.mark.parametrize("thing", THINGS.values(), ids=lambda thing: thing.name)
class TestEachThing:
    def test_lies_within_half_the_distance_of_two_places(self, thing: Shape) -> None:
        reach_m = np.linalg.norm(points_of(thing)[:, :2], axis=1).max()
        assert 0.01 < reach_m <= MIXED_MIN_DISTANCE_M / 2

    def test_is_no_higher_than_what_places_beside_a_task_are_for(self, thing: Shape) -> None:
        assert np.ptp(points_of(thing)[:, 2]) <= THING_HEIGHT_M

    def test_rests_on_the_table(self, thing: Shape) -> None:
        assert points_of(thing)[:, 2].min() == pytest.approx(-thing.rest_height_m, abs=0.05 * MM)

    def test_leaves_room_for_the_gripper_that_comes_to_rest_above_it(self, thing: Shape) -> None:
        assert points_of(thing)[:, 2].max() <= CUBES.rest_above_m - 10 * MM

    def test_stands_on_more_than_a_line(self, thing: Shape) -> None:
        points = points_of(thing)
        touching = points[points[:, 2] < -thing.rest_height_m + 0.6 * MM, :2]
        widths = np.linalg.svd(touching - touching.mean(axis=0), compute_uv=False) / math.sqrt(len(touching))
        assert thing.name in ("apple", "carrot") or widths[1] > 1 * MM

    def test_each_part_has_a_colour(self, thing: Shape) -> None:
        assert all(part.rgb is not None for part in thing.parts)


def test_any_two_differ_in_shape_and_in_colour() -> None:
    assert len(THINGS) >= 12
    for one, other in itertools.combinations(THINGS.values(), 2):
        assert {part.rgb for part in one.parts} != {part.rgb for part in other.parts}
        sizes = [np.ptp(points_of(thing), axis=0) for thing in (one, other)]
        assert np.abs(sizes[0] - sizes[1]).max() > 2 * MM
