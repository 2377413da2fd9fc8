#!/usr/bin/env python3
"""Find the triangles of the wrist camera's mesh that a view from outside can show; write them as bits.

SAPIEN draws only front faces. A triangle is visible from outside if a ray from its front side leaves the mesh
and meets no other front face on the way. Each search adds what it finds, with `RINGS` rings of neighbours:

1. From random points of each triangle, rays to random directions.
2. From outside, parallel rays of a random direction, `GRID_MM` apart. A triangle is added if it lies less
   than `MARGIN_MM` behind what the ray meets first: a rasteriser rounds corners and depths. This is repeated
   until `DIRECTIONS` directions in a row have added nothing.

Needs `pip install embreex`; takes some 10 minutes of one core:

    python scripts/visible_triangles.py PATH/TO/d415.stl vla_eval/tasks/arm/d415_visible.bin
"""

import argparse
import struct
import sys
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

RAYS_PER_TRIANGLE = 64
DIRECTIONS = 400
RINGS = 3  # of neighbours
GRID_MM = 0.1
MARGIN_MM = 0.1
LIFT_MM = 1e-3  # so that a ray does not meet the triangle that it comes from
MAX_BACK_FACES = 32  # a ray that passes more back faces than these counts as blocked
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class Met(NamedTuple):
    """What each ray meets first: the triangle's index or -1, and how far away."""

    triangle: np.ndarray
    distance_mm: np.ndarray


def meet(corners_mm: np.ndarray, indices: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> Met:
    """Return what rays meet of the triangles with these indices; the triangles are solid from both sides."""
    if not len(indices):
        return Met(np.full(len(origins), -1), np.full(len(origins), np.inf))
    scene = EmbreeScene()
    TriangleMesh(scene, corners_mm[indices])
    found = scene.run(origins, rays, output=True)
    triangle = np.where(found["primID"] >= 0, indices[found["primID"]], -1)
    return Met(triangle, np.where(triangle >= 0, found["tfar"], np.inf))


def unit_normals(corners_mm: np.ndarray) -> np.ndarray:
    """Return (T, 3) of the front sides; 0 for triangles without an area, which nothing draws."""
    first, second, third = corners_mm.astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def escaping(corners_mm: np.ndarray, normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (T,) bool: of which triangles a ray leaves the mesh through back faces at most."""
    scene = EmbreeScene()
    TriangleMesh(scene, corners_mm)
    first, second, third = corners_mm.astype(np.float64).transpose(1, 0, 2)
    escaped = np.zeros(len(corners_mm), bool)
    for _ in range(RAYS_PER_TRIANGLE):
        rest = np.flatnonzero(~escaped & normals.any(axis=1))
        along = rng.random((len(rest), 2, 1))
        along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)
        points = first[rest] + along[:, 0] * (second - first)[rest] + along[:, 1] * (third - first)[rest]
        points += LIFT_MM * normals[rest]
        rays = rng.normal(size=points.shape)
        rays *= np.sign((rays * normals[rest]).sum(axis=1, keepdims=True))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for _ in range(MAX_BACK_FACES):
            found = scene.run(points.astype(np.float32), rays.astype(np.float32), output=True)
            met = found["primID"]
            escaped[rest[met < 0]] = True
            # A face that looks along the ray is a front face for a camera at its end: it hides the triangle.
            passes = (met >= 0) & ((normals[met] * rays).sum(axis=1) < 0)
            if not passes.any():
                break
            points = points[passes] + (found["tfar"][passes, None] + LIFT_MM) * rays[passes]
            rays, rest = rays[passes], rest[passes]
    return escaped


def parallel_rays(corners_mm: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return origins outside the mesh, on a grid with a random offset, and one random direction."""
    points = corners_mm.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    box = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    far_mm = 1.1 * np.linalg.norm(box, axis=1).max()
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    across = np.cross(direction, [0, 0, 1] if abs(direction[2]) < 0.9 else [1, 0, 0])
    across /= np.linalg.norm(across)
    axes = (across, np.cross(direction, across))
    first, second = np.meshgrid(
        *(
            np.arange((box @ axis).min() + rng.uniform(0, GRID_MM), (box @ axis).max(), GRID_MM)
            for axis in axes
        )
    )
    origins = first.reshape(-1, 1) * axes[0] + second.reshape(-1, 1) * axes[1] - far_mm * direction
    return origins.astype(np.float32), direction.astype(np.float32)


def missed(
    corners_mm: np.ndarray, normals: np.ndarray, kept: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, int]:
    """Return the left-out triangles that rays of one direction show, and how many rays lead to any."""
    origins, direction = parallel_rays(corners_mm, rng)
    rays = np.broadcast_to(direction, origins.shape).copy()
    in_front = normals @ direction < 0
    hidden = meet(corners_mm, np.flatnonzero(in_front & ~kept), origins, rays)
    met = np.flatnonzero(hidden.triangle >= 0)
    near = meet(corners_mm, np.flatnonzero(in_front & kept), origins[met], rays[met])
    seen = hidden.distance_mm[met] < near.distance_mm + MARGIN_MM
    return np.unique(hidden.triangle[met][seen]), len(met)


def with_neighbours(corners: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return (T,) bool: the chosen triangles, all that share a corner with one of them, and so on."""
    raw = np.ascontiguousarray(corners.reshape(-1, 3)).view([("", np.float32)] * 3).reshape(-1)
    _, corner = np.unique(raw, return_inverse=True)
    corner = corner.reshape(-1, 3)
    for _ in range(RINGS):
        touched = np.zeros(corner.max() + 1, bool)
        touched[corner[chosen]] = True
        chosen = touched[corner].any(axis=1)
    return chosen


def visible(corners: np.ndarray, known: np.ndarray | None, out: Path) -> np.ndarray:
    """Return (T,) bool: what a view from outside can show, `known` or not; write and print its progress."""
    middle = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
    corners_mm = np.ascontiguousarray((corners - middle) * 1000, dtype=np.float32)
    normals = unit_normals(corners_mm)
    rng = np.random.default_rng(1 if known is None else int(known.sum()))
    kept = with_neighbours(corners, escaping(corners_mm, normals, rng) if known is None else known)
    print(f"{kept.sum()} to begin with", flush=True)
    in_a_row = n_rays = 0  # without a find
    while in_a_row < DIRECTIONS:
        found, n_met = missed(corners_mm, normals, kept, rng)
        if len(found):
            chosen = np.zeros(len(kept), bool)
            chosen[found] = True
            kept |= with_neighbours(corners, chosen)
            write(out, kept)
            print(f"{kept.sum()}: {len(found)} more after {in_a_row} directions without", flush=True)
        in_a_row, n_rays = (0, 0) if len(found) else (in_a_row + 1, n_rays + n_met)
    print(f"none of {n_rays} rays that lead to a triangle that was left out comes near it")
    return kept


def write(out: Path, kept: np.ndarray) -> None:
    """Write (T,) bool as bits."""
    out.write_bytes(zlib.compress(np.packbits(kept).tobytes(), 9))


def main() -> int:
    """Write the bits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stl", type=Path)
    parser.add_argument("out", type=Path, help="continues from this file if it is there")
    args = parser.parse_args()
    stl = args.stl.read_bytes()
    (count,) = struct.unpack_from("<I", stl, 80)
    known = None
    if args.out.exists():
        bits = np.frombuffer(zlib.decompress(args.out.read_bytes()), np.uint8)
        known = np.unpackbits(bits, count=count).astype(bool)
    kept = visible(np.frombuffer(stl, RECORD, count=count, offset=84)["corners"], known, args.out)
    write(args.out, kept)
    print(f"{kept.sum()} of {count} triangles are kept: {args.out}, {args.out.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
