"""Where things stand that are no part of a task: clear of all that it uses, and in the base camera's view.

A task says which areas of the table its objects and the hand can use in any episode. The places are those of
a fixed grid that are clear of all of them, so where a thing stands depends on nothing else of the episode,
and says nothing about the answer. Knows nothing of simulators.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vla_eval.robots.arm import Xyz
from vla_eval.tasks.interface import BASE_CAMERA_M, CAMERA_FOV_RAD, base_camera_axes
from vla_eval.tasks.objects.item_names import THING_NAMES
from vla_eval.tasks.objects.layout import (
    DISC_Y_M,
    GOAL_OFFSET_X_M,
    GOAL_X_M,
    GOAL_Y_M,
    JITTER_STD_M,
    LAYOUT_HALF_RANGE_M,
    MIXED_MIN_DISTANCE_M,
    MUG_SPACING_M,
    PEG_RANGE_M,
    SPAWN_X_M,
    START_BAND_WIDTH_M,
    START_BANDS_Y_M,
    START_X_M,
    Plane,
    bunch_place_m,
    slot_centres_m,
)

THING_RADIUS_M = MIXED_MIN_DISTANCE_M / 2  # no thing reaches farther from its origin
THING_HEIGHT_M = 0.06  # nor is one higher: the bottle has 5.8 cm
HAND_M = 0.06  # from the tool centre point to the outside of the open fingers
BEHIND_BALL_M = 0.07  # the hand comes from so far behind the ball to deflect it
ITEM_SHIFT_M = 4 * JITTER_STD_M
SHOWN_HALF_M = 0.05  # a cube of 6 cm, and some air
MUG_HALF_M = 0.071  # with its handle
PUSHED_ON_M = 0.03  # beyond where it has to be
BASE_RADIUS_M = 0.2  # of the robot's base, and of what the arm at rest hides behind it

GRID_X_M = np.arange(-0.55, 0.36, 0.1)
GRID_Y_M = np.arange(-0.6, 0.61, 0.1)
SHIFT_M = 0.015  # of a thing from its place, in x and y: neighbours stay 7 cm apart
N_PLACES = 24  # nearest to what the task uses: twice as many as there are things
SEEN_SHARE = 0.92  # of the half width of the image, within which the middle of a thing is seen
N_SHADOW = 8  # points at which what a thing hides from the camera is checked


class Area(NamedTuple):
    """All points within a distance of a rectangle of the table; world frame, m."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    margin_m: float

    def distance_m(self, points_m: Plane) -> Plane:
        """Return (…) how far points (…, 2) are outside of it, negative if they are inside."""
        gaps = [
            np.maximum(np.maximum(least - points_m[..., axis], points_m[..., axis] - most), 0)
            for axis, (least, most) in enumerate((self.x_m, self.y_m))
        ]
        distance: Plane = np.hypot(*gaps) - self.margin_m
        return distance


def used_areas(**arguments: Any) -> tuple[Area, ...]:  # Any: plain data of many types
    """Return the areas that a task's objects and the hand can use in any episode, by its arguments.

    A class gives the arguments that matter to it, planning all arguments of the task.
    """
    match arguments:
        case {"ball_radius_m": radius_m}:
            lane = (SPAWN_X_M[0] - BEHIND_BALL_M, math.inf)  # deflected, it rolls on
            disc = (SPAWN_X_M[0] + GOAL_OFFSET_X_M, SPAWN_X_M[1] + GOAL_OFFSET_X_M)
            return (
                Area(lane, (-math.inf, math.inf), max(radius_m, HAND_M / 2)),
                Area(disc, DISC_Y_M, arguments.get("goal_radius_m", 0.0)),
            )
        case {"peg_half_length_m": length_m, "peg_half_width_m": width_m}:
            within = (-PEG_RANGE_M, PEG_RANGE_M)
            return (Area(within, within, math.hypot(length_m, width_m) + HAND_M),)
        case {"goal_radius_m": goal_m, "return_radius_m": back_m, "cube_half_size_m": half_m}:
            ys = (START_BANDS_Y_M[0], START_BANDS_Y_M[-1] + START_BAND_WIDTH_M, *GOAL_Y_M)
            reach_m = max(goal_m, back_m, half_m * math.sqrt(2)) + HAND_M
            return (Area((START_X_M[0], GOAL_X_M[1]), (min(ys), max(ys)), reach_m),)
        case {"mug": _}:
            return (_mugs(arguments),)
        case {"n_items": n_items, "goal_threshold_m": threshold_m}:
            n_cues = n_items if "n_shown" in arguments else 0
            shown = [(0.0, 0.0), *(bunch_place_m(index, n_items) for index in range(n_cues))]
            # The hand may go from one item to the next, low over the table.
            return (
                _around(slot_centres_m(n_items).tolist(), ITEM_SHIFT_M + max(HAND_M, threshold_m)),
                _around(shown, SHOWN_HALF_M),
            )
    raise AssertionError(f"no task has only these arguments: {', '.join(arguments)}")


def _around(points_m: Sequence[Sequence[float]], margin_m: float) -> Area:
    x_m, y_m = zip(*points_m, strict=True)
    return Area((min(x_m), max(x_m)), (min(y_m), max(y_m)), margin_m)


def _mugs(arguments: Mapping[str, Any]) -> Area:
    """Return where mugs stand and are pushed, with the hand beside them or over them."""
    moved = "push_distance_m" in arguments or "lift_height_m" in arguments
    pushed_m = arguments["push_distance_m"] + PUSHED_ON_M if "push_distance_m" in arguments else 0.0
    touched_m = 0.0 if moved else arguments["goal_threshold_m"]
    return Area(
        (-LAYOUT_HALF_RANGE_M, LAYOUT_HALF_RANGE_M + pushed_m),
        (-LAYOUT_HALF_RANGE_M - MUG_SPACING_M, LAYOUT_HALF_RANGE_M + MUG_SPACING_M),
        max(MUG_HALF_M + HAND_M, touched_m),
    )


def _base_area(base_m: Xyz) -> Area:
    """Return where the robot stands, and what it hides from the camera."""
    x, y, _ = base_m
    return Area((x, x), (y, y), BASE_RADIUS_M)


def free_places_m(areas: tuple[Area, ...], *, base_m: Xyz) -> Plane:
    """Return (S, 2) the places nearest to the areas where a thing uses none of them, hides none, and is seen.

    Each is at least 7 cm from the others after all are shifted, so that S things always fit. There are at
    most `N_PLACES`. None is in the way of the robot whose root is at `base_m`, world frame.
    """
    grid = np.stack(np.meshgrid(GRID_X_M, GRID_Y_M, indexing="ij"), axis=-1).reshape(-1, 2)
    eye = np.array(BASE_CAMERA_M[0])
    height = THING_HEIGHT_M / (eye[2] - THING_HEIGHT_M)
    # What the top of a thing hides is on the table, from its foot on away from the camera.
    shares = np.linspace(0, height, N_SHADOW)[:, None, None]
    hidden = grid + shares * (grid - eye[:2])
    reach_m = THING_RADIUS_M * (1 + height) + math.hypot(SHIFT_M, SHIFT_M) * (1 + height)
    distances = np.stack([area.distance_m(hidden).min(axis=0) for area in areas]).min(axis=0)
    from_base = _base_area(base_m).distance_m(hidden).min(axis=0)
    free = (np.minimum(distances, from_base) >= reach_m) & _seen(grid)
    # Rounded: the last bits of equal distances differ, also between machines.
    nearest = np.argsort(distances[free].round(6), kind="stable")[:N_PLACES]
    places: Plane = grid[free][nearest]
    return places


def _seen(points_m: Plane) -> Any:  # (…) bool
    """Return (…) whether points on the table are in the base camera's image, not at its very edge."""
    eye, (ahead, right, up) = base_camera_axes()
    ways = np.concatenate((points_m, np.zeros((*points_m.shape[:-1], 1))), axis=-1) - eye
    edge = ways @ ahead * math.tan(CAMERA_FOV_RAD / 2) * SEEN_SHARE
    return (np.abs(ways @ right) <= edge) & (np.abs(ways @ up) <= edge)


def free_things(candidates: Collection[str]) -> tuple[str, ...]:
    """Return the names of the everyday things that are none of a task's candidates, in their order."""
    return tuple(name for name in THING_NAMES if name not in candidates)


def drawn_poses(places_m: Plane, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return (S, 3): x, y in m and yaw in rad of as many things as fit, world frame.

    The first N of them are where N things stand: one more changes nothing about the others.
    """
    order = rng.permutation(len(places_m))
    shifted = places_m[order] + rng.uniform(-SHIFT_M, SHIFT_M, places_m.shape)
    return np.column_stack((shifted, rng.uniform(-math.pi, math.pi, len(places_m))))
