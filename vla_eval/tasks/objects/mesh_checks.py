"""Which meshes can be things of a task: their size, whether they are closed, and whether they stand.

Nothing is repaired, scaled or turned. Knows nothing of files.
"""

import hashlib
import math
from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from vla_eval.tasks.objects.layout import MIXED_MIN_DISTANCE_M
from vla_eval.tasks.objects.mesh_folder import UnusableMeshError
from vla_eval.tasks.objects.mesh_reading import reading
from vla_eval.tasks.objects.solids import Solid, Surface

MAX_RADIUS_M = MIXED_MIN_DISTANCE_M / 2  # about the vertical through its middle: so far apart are neighbours
MAX_HEIGHT_M = 0.06  # the hand comes to rest 4 cm above the middle of a thing
MIN_LONGEST_M = 0.02  # the edge of the smallest cube that `cube_half_size_m` allows
MIN_THICKNESS_M = 0.002
ROUNDING_M, N_CENTRE_STEPS = 1e-6, 500
NAMED_UNITS = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches"}
TILTS_RAD = np.deg2rad(np.arange(2, 61, 2))
# Of the centre of mass, as a thing is tilted: a ball of flat triangles never drops by as much, and what
# stands rises by more before it falls.
MAX_DROP_M, LEAST_RISE_M = 0.0005, 0.0001
# Rows (N, D) -> the index of one of each kind, and of each row's among these. trimesh has no types for it.
_unique_rows: Callable[..., tuple[NDArray[np.int64], NDArray[np.int64]]] = trimesh.grouping.unique_rows


def solid_of(surfaces: list[Surface], *, allow_holes: bool) -> Solid:
    """Return surfaces in the frame of an item, if a task can have the thing.

    Raises:
        UnusableMeshError: it cannot; without a full stop.
    """
    corners = np.concatenate([one.vertices_m[one.triangles.ravel()] for one in surfaces]).astype(np.float64)
    least, most = corners.min(axis=0), corners.max(axis=0)
    if (most - least).min() == 0:
        raise UnusableMeshError("it is flat, expected a body. Thicken it")
    with reading():
        middle = np.append(_round_centre(corners[:, :2]), (least[2] + most[2]) / 2)
    _check_size(corners - middle, most - least)
    n_open = _open_edges(corners)
    if n_open and not allow_holes:
        raise UnusableMeshError(
            f"its surface has holes ({n_open} open edges), expected a closed one (watertight). Close it, or "
            "set env.mesh_holes=true: its convex hull touches in any case, and the holes are seen"
        )
    if not n_open and _volume_m3(corners) <= 0:
        raise UnusableMeshError("its triangles face inwards, and only their backs would be seen. Flip them")
    with reading():
        hull = trimesh.Trimesh(corners - middle, np.arange(len(corners)).reshape(-1, 3)).convex_hull
    _check_steady(np.asarray(hull.vertices), np.asarray(hull.center_mass))
    moved = [one._replace(vertices_m=(one.vertices_m - middle).astype(np.float32)) for one in surfaces]
    return Solid(tuple(moved), np.asarray(hull.vertices, dtype=np.float32), float(most[2] - least[2]))


def _round_centre(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centre of a circle around (P, 2) that is hardly larger than the smallest one.

    From the middle of the bounding box, it moves towards the farthest point by less and less.
    Source: Badoiu, Clarkson, "Smaller core-sets for balls", 2003, section 3.
    """
    points = points[ConvexHull(points).vertices]
    centre = best = (points.min(axis=0) + points.max(axis=0)) / 2
    least = np.hypot(*(points - centre).T).max()
    for step in range(1, N_CENTRE_STEPS):
        distances = np.hypot(*(points - centre).T)
        if distances.max() < least - ROUNDING_M:
            least, best = distances.max(), centre
        centre = centre + (points[distances.argmax()] - centre) / (step + 1)
    return np.asarray(best)


def _check_size(corners_m: NDArray[np.float64], extents_m: NDArray[np.float64]) -> None:
    radius_m, height_m = float(np.hypot(*corners_m.T[:2]).max()), float(extents_m[2])
    found = " x ".join(f"{edge:.3g}" for edge in extents_m)

    def fits(factor: float) -> bool:
        return (
            radius_m * factor <= MAX_RADIUS_M + ROUNDING_M
            and height_m * factor <= MAX_HEIGHT_M + ROUNDING_M
            and extents_m.max() * factor >= MIN_LONGEST_M - ROUNDING_M
        )

    if not fits(1.0):
        factor, unit = next(((f, unit) for f, unit in NAMED_UNITS.items() if fits(f)), (0.0, ""))
        largest = min(MAX_RADIUS_M / max(radius_m, 1e-12), MAX_HEIGHT_M / max(height_m, 1e-12))
        hint = (
            f"It looks like {unit}: scale the file by {factor:g}, or set env.mesh_scale={factor:g}"
            if unit
            else f"Scale the file, or set env.mesh_scale (at most {_floor(largest):g} for it)"
        )
        raise UnusableMeshError(
            f"it is {found} m large, expected at most {MAX_HEIGHT_M:g} m high, within {MAX_RADIUS_M:g} m of "
            f"the vertical through its middle, and at least {MIN_LONGEST_M:g} m long. {hint}"
        )
    if extents_m.min() < MIN_THICKNESS_M:
        raise UnusableMeshError(
            f"it is {found} m large, expected a body at least {MIN_THICKNESS_M:g} m thick. Thicken it"
        )


def _floor(number: float) -> float:
    """Return a number with two digits, not above it."""
    unit = 10.0 ** (math.floor(math.log10(number)) - 1)
    return math.floor(number / unit) * unit


def _open_edges(corners: NDArray[np.float64]) -> int:
    """Return how many edges are not shared by two triangles; corners at one place are one corner."""
    _, index = _unique_rows(corners, digits=7)
    triangles = index.reshape(-1, 3)
    edges = np.sort(np.concatenate((triangles[:, :2], triangles[:, 1:], triangles[:, ::2])), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]  # of triangles without an area
    _, counts = np.unique(edges[:, 0] * len(corners) + edges[:, 1], return_counts=True)
    return int((counts % 2).sum())


def _volume_m3(corners_m: NDArray[np.float64]) -> float:
    """Return the volume that triangles, three corners each, enclose: negative if they face inwards."""
    first, second, third = corners_m.reshape(-1, 3, 3).transpose(1, 0, 2)
    return float((first * np.cross(second, third)).sum() / 6)


def _check_steady(hull_m: NDArray[np.float64], centre_m: NDArray[np.float64]) -> None:
    """Refuse a thing that falls over as it stands in its file: tilted, its centre of mass drops at once."""
    corners = hull_m - centre_m
    angles = np.linspace(0, 2 * math.pi, 64, endpoint=False)
    outwards = corners[:, :2] @ np.stack((np.cos(angles), np.sin(angles)))  # (H, 64), in each direction

    def heights_m(tilt_rad: float) -> NDArray[np.float64]:
        return np.asarray((outwards * math.sin(tilt_rad) - corners[:, 2:] * math.cos(tilt_rad)).max(axis=0))

    risen_m = np.stack([heights_m(tilt) for tilt in TILTS_RAD]) - heights_m(0.0)  # (tilts, 64)
    most_so_far = np.maximum.accumulate(risen_m)
    falls = (risen_m < -MAX_DROP_M) & (most_so_far < LEAST_RISE_M)
    if falls.any():
        first = math.degrees(TILTS_RAD[falls.any(axis=1).argmax()])
        raise UnusableMeshError(
            "it falls over as it stands in its file (z is up, in glTF y, as its specification says): its "
            f"centre of mass drops as it is tilted, by {MAX_DROP_M * 1000:g} mm within {first:.0f} degrees. "
            "Turn it, so that it rests on a face"
        )


def looks(solid: Solid) -> bytes:
    """Return a digest of what makes a thing look as it does: equal for one mesh in two files."""
    digest = hashlib.sha256()
    for one in solid.surfaces:
        corners = one.vertices_m[one.triangles].astype(np.float64)  # (T, 3, 3)
        sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area_mm2 = round(float(np.linalg.norm(sides, axis=1).sum() / 2 * 1e6), 2)
        places = np.round(corners.reshape(-1, 3), 6) + 0.0  # no negative zero
        places = places[_unique_rows(places, digits=6)[0]]
        places = places[np.lexsort(places.T)]
        digest.update(f"{len(places)} {area_mm2} {one.rgb}".encode() + places.tobytes())
        digest.update(b"" if one.texture is None else one.texture.tobytes())
    return digest.digest()
