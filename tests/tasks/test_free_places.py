"""Places beside a task: clear of what it uses, in view, hiding nothing, and enough of them."""

import itertools
import math
import random
from typing import Any

import numpy as np
import pytest

from vla_eval.robots.rows import PANDA, ROWS
from vla_eval.tasks.objects.free_places import (
    HAND_M,
    Area,
    drawn_poses,
    free_places_m,
    free_things,
    used_areas,
)
from vla_eval.tasks.objects.item_names import THING_NAMES
from vla_eval.tasks.objects.layout import slot_centres_m

RADIUS_M = 0.0305  # of the things, as `test_things` has it
EYE_M = np.array([0.3, 0.0, 0.6])  # of the base camera, which looks down by this angle, and along -x
PITCH_RAD = math.atan2(0.5, 0.4)
CASES: dict[str, dict[str, list[Any]]] = {
    "items": {"n_items": [*range(2, 16)], "goal_threshold_m": [0.01, 0.05, 0.1]},
    "shown": {"n_items": [*range(2, 10)], "n_shown": [1, 2], "goal_threshold_m": [0.02, 0.05]},
    "touched": {"mug": ["primitive"], "goal_threshold_m": [0.05, 0.08, 0.15]},
    "pushed": {"mug": ["primitive"], "push_distance_m": [0.05, 0.1, 0.15]},
    "lifted": {"mug": ["primitive"], "lift_height_m": [0.1]},
    "ball": {"ball_radius_m": [0.01, 0.02, 0.04]},
    "disc": {"ball_radius_m": [0.02], "goal_radius_m": [0.05, 0.1]},
    "peg": {"peg_half_length_m": [0.05, 0.12, 0.2], "peg_half_width_m": [0.02, 0.03]},
    "cube": {
        "goal_radius_m": [0.05, 0.08, 0.14],
        "return_radius_m": [0.05, 0.2],
        "cube_half_size_m": [0.02],
    },
}


def cases() -> list[tuple[str, dict[str, Any]]]:
    return [
        (name, dict(zip(values, chosen, strict=True)))
        for name, values in CASES.items()
        for chosen in itertools.product(*values.values())
    ]


def in_image(point_m: np.ndarray) -> tuple[float, float]:
    """Where a point is in the base camera's image: (right, down), ±1 at the edges of its 90 degrees."""
    ahead, up = (EYE_M - point_m)[0], (point_m - EYE_M)[2]
    depth = ahead * math.cos(PITCH_RAD) - up * math.sin(PITCH_RAD)
    down = -ahead * math.sin(PITCH_RAD) - up * math.cos(PITCH_RAD)
    return point_m[1] / depth, down / depth


def rim(x: float, y: float, z: float = 0.0) -> list[np.ndarray]:
    turns = np.linspace(0, 2 * math.pi, 8, endpoint=False)
    return [np.array([x + RADIUS_M * math.cos(a), y + RADIUS_M * math.sin(a), z]) for a in turns]


@pytest.mark.parametrize("arm", ROWS, ids=lambda arm: arm.name)
def test_whatever_is_drawn_is_clear_of_the_task_apart_in_view_and_hides_nothing(arm: Any) -> None:
    rng = random.Random(arm.name)
    for name, arguments in rng.sample(cases(), 8):
        areas = used_areas(**arguments)
        places = free_places_m(areas, base_m=arm.base_m)
        poses = drawn_poses(places, np.random.default_rng(rng.randrange(10**6)))
        assert len(poses) == len(places) <= 24
        assert len(places) or name in ("ball", "disc", "peg", "cube"), arguments
        for x, y, yaw in poses.tolist():
            assert -math.pi <= yaw <= math.pi
            for point in rim(x, y):
                assert all(area.distance_m(point[:2]) >= 0 for area in areas), (name, arguments)
            for point in rim(x, y, z=0.06):  # on the table behind it, seen from the camera
                behind = EYE_M + (point - EYE_M) * EYE_M[2] / (EYE_M[2] - point[2])
                assert all(area.distance_m(behind[:2]) >= 0 for area in areas), (name, arguments)
            right, down = in_image(np.array([x, y, 0.0]))
            assert max(abs(right), abs(down)) < 1
            assert math.dist((x, y), arm.base_m[:2]) >= 0.2 + RADIUS_M
        for one, other in itertools.combinations(poses[:, :2].tolist(), 2):
            assert math.dist(one, other) >= 2 * RADIUS_M


def test_where_things_stand_depends_on_the_generator_alone() -> None:
    places = free_places_m(used_areas(n_items=3, goal_threshold_m=0.05), base_m=PANDA.base_m)
    drawn = [drawn_poses(places, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])


def test_each_place_is_used_as_often_as_any_other() -> None:
    places = free_places_m(used_areas(n_items=3, goal_threshold_m=0.05), base_m=PANDA.base_m)
    first = np.array([drawn_poses(places, np.random.default_rng(seed))[0, :2] for seed in range(4800)])
    nearest = np.linalg.norm(first[:, None] - places, axis=2).argmin(axis=1)
    counts = np.bincount(nearest, minlength=len(places))
    assert len(places) == 24
    # Binomial of 4,800 draws at 1/24: 200 expected, standard deviation 13.8; within 5 of them.
    assert np.abs(counts - 200).max() < 70


@pytest.mark.parametrize(("n_items", "most"), [(3, 12 - 3), (9, 12 - 9), (12, 0)])
def test_a_candidate_is_never_in_the_way_of_itself(n_items: int, most: int) -> None:
    candidates = THING_NAMES[:n_items]
    assert len(free_things(candidates)) == most
    assert not set(free_things(candidates)) & set(candidates)
    assert free_things(("red_cube",)) == THING_NAMES


def test_a_larger_threshold_keeps_things_farther_away() -> None:
    """A hand that rests on a thing must not be within reach of a candidate."""
    for threshold_m in (0.05, 0.1, 0.15):
        areas = used_areas(n_items=3, goal_threshold_m=threshold_m)
        for x, y in free_places_m(areas, base_m=PANDA.base_m).tolist():
            distances = [math.dist((x, y), slot) for slot in slot_centres_m(3).tolist()]
            assert min(distances) > threshold_m + 0.04 + RADIUS_M  # and the items' shift of 4 cm


def test_distances_to_an_area() -> None:
    area = Area((0.0, 2.0), (-1.0, 1.0), 0.5)
    points = np.array([[1.0, 0.0], [2.5, 0.0], [3.0, 0.0], [5.0, 5.0], [-3.0, 5.0]])
    # 5 = hypot(3, 4) from the corner (2, 1) and from (0, 1).
    np.testing.assert_allclose(area.distance_m(points), [-0.5, 0.0, 0.5, 4.5, 4.5])
    lane = Area((0.0, math.inf), (-math.inf, math.inf), HAND_M)
    np.testing.assert_allclose(lane.distance_m(np.array([[9.0, 9.0], [-1.0, -9.0]])), [-HAND_M, 1 - HAND_M])
