"""A triangle is left out only where it covers the centre of no pixel."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vla_eval.envs.pixel_cover import LARGEST_PX, Lens, Mesh, covering

Array = NDArray[np.float64]
LENS = Lens(focal_px=(20.0, 22.0), centre_px=(15.5, 12.0), size_px=(32, 24), near_m=0.01)
AHEAD = np.eye(4)


def seen(triangles: Array, view: Array = AHEAD, lens: Lens = LENS) -> list[bool]:
    """Return what is said of triangles (T, 3, 3), whose corners are points of their own."""
    mesh = Mesh.of(triangles.reshape(-1, 3).astype(np.float32), np.arange(3 * len(triangles)).reshape(-1, 3))
    chosen: list[bool] = covering(mesh, view, lens).tolist()
    return chosen


def at_pixels(*corners: tuple[float, float], depth_m: float = 0.5) -> Array:
    """Return a triangle (1, 3, 3) whose corners are seen at these columns and rows of the image."""
    (fx, fy), (cx, cy) = LENS.focal_px, LENS.centre_px
    return np.array([[(depth_m, (cx - u) * depth_m / fx, (cy - v) * depth_m / fy) for u, v in corners]])


def hit(triangles: Array, lens: Lens) -> NDArray[np.bool_]:
    """Return (T,): whether a ray through a pixel's centre meets a triangle, either side.

    Möller and Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection".
    """
    width, height = lens.size_px
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(
        (
            np.ones(u.size),
            (lens.centre_px[0] - u.ravel()) / lens.focal_px[0],
            (lens.centre_px[1] - v.ravel()) / lens.focal_px[1],
        ),
        axis=1,
    )
    found = np.zeros(len(triangles), np.bool_)
    for index, (a, b, c) in enumerate(triangles):
        across = np.cross(rays, c - a)
        size = across @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            first = across @ -a / size
            turned = np.cross(-a, b - a)
            second, depth = rays @ turned / size, (c - a) @ turned / size
        meets = (first >= 0) & (second >= 0) & (first + second <= 1) & (depth >= lens.near_m)
        found[index] = meets.any()
    return found


def random_view(rng: np.random.Generator) -> Array:
    view = np.eye(4)
    view[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    view[:3, 3] = rng.normal(scale=0.2, size=3)
    return view


@pytest.mark.parametrize("size_m", [0.003, 0.03, 0.3, 3.0])
@pytest.mark.parametrize("seed", range(5))
def test_no_triangle_that_a_pixel_shows_is_left_out(seed: int, size_m: float) -> None:
    """All around the camera, some through it, some behind."""
    rng = np.random.default_rng(seed)
    triangles = rng.uniform(-0.6, 0.6, (300, 1, 3)) + rng.normal(scale=size_m, size=(300, 3, 3))
    view = random_view(rng)
    truth = hit(triangles @ view[:3, :3].T + view[:3, 3], LENS)
    chosen = np.array(seen(triangles, view))
    assert not (truth & ~chosen).any()
    assert truth.any() or size_m < 0.01


def test_triangles_much_smaller_than_a_pixel_are_hardly_ever_kept() -> None:
    rng = np.random.default_rng(0)
    corners = at_pixels((16, 12))[0, 0] + rng.uniform(-0.2, 0.2, (2000, 1, 3)) * (0, 1, 1)
    triangles = corners + rng.normal(scale=0.001, size=(2000, 3, 3))  # a pixel is 2 cm wide there
    assert np.mean(seen(triangles)) < 0.05


@pytest.mark.parametrize(
    ("corners", "is_kept"),
    [
        (((10.6, 8.6), (11.4, 8.6), (10.6, 9.4)), False),  # between four centres
        (((10.4, 8.4), (10.6, 8.4), (10.4, 8.6)), True),  # the box around it holds a centre
        (((10.6, 2.0), (11.4, 2.0), (11.0, 20.0)), False),  # between two columns, across many rows
        (((2.0, 8.6), (30.0, 8.6), (16.0, 9.4)), False),  # between two rows
        (((10.5, 8.6), (11.4, 8.6), (10.6, 9.4)), False),  # on a column of centres, between two rows
        (((10.5, 8.5), (11.4, 8.6), (10.6, 9.4)), True),  # a corner on a centre
        (((10.49, 8.51), (11.4, 8.6), (10.6, 9.4)), True),  # too near to one to tell
        (((-30, 5), (-2, 5), (-2, 9)), False),  # left of the image
        (((40, -3), (90, -3), (40, -1)), False),  # above, and beyond its right edge
        (((-100, -100), (200, -100), (-100, 200)), True),  # the whole image
        (((31.4, 23.4), (31.6, 23.4), (31.6, 23.6)), True),  # the last centre
        (((31.6, 23.6), (33, 23.6), (33, 25)), False),  # beyond it
    ],
)
def test_a_triangle_is_kept_if_it_spans_columns_and_rows_of_centres(
    corners: tuple[tuple[float, float], ...], is_kept: bool
) -> None:
    one = at_pixels(*corners)
    assert seen(one) == seen(one[:, ::-1]) == [is_kept]


def test_what_is_behind_is_left_out_and_what_reaches_behind_is_kept() -> None:
    behind = at_pixels((0, 0), (32, 0), (0, 24), depth_m=-0.5)
    through = behind.copy()
    through[0, 0, 0] = 0.5
    both = np.concatenate([behind, through])
    assert seen(both) == seen(both[:, ::-1]) == [False, True]


def test_points_at_the_same_place_are_one() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    order = rng.integers(0, 50, (200, 3))
    mesh = Mesh.of(points[order.ravel()], np.arange(600).reshape(-1, 3))
    assert mesh.points.shape == (3, len(np.unique(order)))
    for corner in range(3):
        np.testing.assert_array_equal(mesh.points[:, mesh.corners[corner]].T, points[order[:, corner]])


def test_an_image_too_large_to_number_its_pixels_leaves_nothing_out() -> None:
    lens = Lens(focal_px=(1.0, 1.0), centre_px=(0.0, 0.0), size_px=(LARGEST_PX + 1, 1), near_m=0.01)
    assert seen(at_pixels((1, 1), (1, 1), (1, 1)), lens=lens) == [True]
