"""Adaptive action grids: where the bins of translation and rotation lie. Knows no network.

A translation is given by its direction (theta from the z axis, phi around it) and its length r, in
normalised units; a rotation by its three numbers. On each axis the edges are either even or quantiles of a
Gaussian that was fitted to the actions of a dataset, cut to the axis' limits, so that common actions get
narrow bins. Source: Qu et al. 2025 (arXiv 2501.15830), section III-B.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
import torch
from torch import Tensor

from vla_eval.errors import RecipeError

AXES = ("theta", "phi", "r", "roll", "pitch", "yaw")
TRANSLATION, ROTATION = slice(0, 3), slice(3, 6)  # of an action, and of the axes
LIMITS: Mapping[str, tuple[float, float]] = {
    "theta": (0.0, math.pi),
    "phi": (-math.pi, math.pi),
    "r": (0.0, math.sqrt(3)),  # the farthest corner of the cube that normalised translations fill
    "roll": (-1.0, 1.0),
    "pitch": (-1.0, 1.0),
    "yaw": (-1.0, 1.0),
}
LEAST_SIGMA = 0.01
"""Narrowest Gaussian that is fitted, in the unit of its axis: a dimension that never varies has none."""
EDGE_TOLERANCE = 1e-6  # of the outermost edges; published ones come from float64 arithmetic


class Gaussian(NamedTuple):
    """Distribution of one axis."""

    mu: float
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionGrid:
    """Edges of the bins of each axis, ascending, in the order of `AXES`; one more than there are bins."""

    edges: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        if len(self.edges) != len(AXES):
            raise RecipeError(f"action grid: expected {len(AXES)} axes, found {len(self.edges)}.")
        for name, edges in zip(AXES, self.edges, strict=True):
            low, high = LIMITS[name]
            rises = all(a < b for a, b in itertools.pairwise(edges))
            covers = abs(edges[0] - low) < EDGE_TOLERANCE and abs(edges[-1] - high) < EDGE_TOLERANCE
            if len(edges) < 3 or not rises or not covers:
                raise RecipeError(
                    f"action grid: the edges of '{name}' must rise from {low:.6g} to {high:.6g}, found "
                    f"{[round(edge, 4) for edge in edges]}."
                )

    @property
    def n_bins(self) -> tuple[int, ...]:
        """Bins of each axis."""
        return tuple(len(edges) - 1 for edges in self.edges)

    def centres(self, axis: int, device: torch.device | None = None) -> Tensor:
        """Return the middles of an axis' bins, float64."""
        edges = torch.tensor(self.edges[axis], dtype=torch.float64, device=device)
        return (edges[:-1] + edges[1:]) / 2

    def bins(self, axis: int, values: Tensor) -> Tensor:
        """Return the bin (…) int64 of each value; what is beyond an axis' limits takes the outermost."""
        inner = torch.tensor(self.edges[axis][1:-1], dtype=torch.float64, device=values.device)
        return torch.bucketize(values.double().contiguous(), inner, right=True)


def uniform_grid(n_bins: Sequence[int]) -> ActionGrid:
    """Return bins of equal width."""
    return ActionGrid(edges=tuple(_even(*LIMITS[name], n) for name, n in zip(AXES, n_bins, strict=True)))


def gaussian_grid(gaussians: Mapping[str, Gaussian], n_bins: Sequence[int]) -> ActionGrid:
    """Return bins of equal probability under a Gaussian per axis, cut to the axis' limits."""
    edges = []
    for name, n in zip(AXES, n_bins, strict=True):
        low, high = LIMITS[name]
        normal = scipy.stats.norm(*gaussians[name])
        shares = _even(float(normal.cdf(low)), float(normal.cdf(high)), n)
        inner = [float(normal.ppf(share)) for share in shares[1:-1]]
        edges.append((low, *inner, high))
    return ActionGrid(edges=tuple(edges))


def fitted_gaussians(actions: Tensor) -> dict[str, Gaussian]:
    """Return mean and standard deviation of each axis over normalised actions (N, 7), gripper aside."""
    if not len(actions):
        raise RecipeError("an action grid is fitted to the actions of a dataset, found none.")
    spherical = to_spherical(actions[:, TRANSLATION].double().clamp(-1, 1))
    values = torch.cat([spherical, actions[:, ROTATION].double().clamp(-1, 1)], dim=-1)
    deviations = values.std(dim=0, correction=0).clamp(min=LEAST_SIGMA)
    return {
        name: Gaussian(float(values[:, axis].mean()), float(deviations[axis]))
        for axis, name in enumerate(AXES)
    }


def to_spherical(xyz: Tensor) -> Tensor:
    """Return theta in [0, π], phi in [-π, π] and r of (…, 3) points."""
    x, y, z = xyz.unbind(dim=-1)
    return torch.stack([torch.atan2((x * x + y * y).sqrt(), z), torch.atan2(y, x), xyz.norm(dim=-1)], dim=-1)


def from_spherical(spherical: Tensor) -> Tensor:
    """Return the points (…, 3) of theta, phi and r."""
    theta, phi, r = spherical.unbind(dim=-1)
    flat = r * theta.sin()
    return torch.stack([flat * phi.cos(), flat * phi.sin(), r * theta.cos()], dim=-1)


def _even(low: float, high: float, n: int) -> tuple[float, ...]:
    # numpy's and not torch's: the original's edges, to the last bit, where an action lies on one.
    return tuple(map(float, np.linspace(low, high, n + 1)))


def refitted(table: Tensor, old: ActionGrid, new: ActionGrid) -> Tensor:
    """Return the table (tokens, D) of the new grid, of as many bins, in the type of the old one.

    A token's embedding is read from the old table at its new place: linearly along each of the three axes,
    between the middles of the old bins, and at the outermost middle beyond it. The gripper's two rows stay.
    What the original does is in docs/spatialvla.md.
    """
    if old.n_bins != new.n_bins:
        raise RecipeError(
            f"an action grid of {old.n_bins} bins cannot be moved to one of {new.n_bins}: the tokens would "
            "not be the same. Leave the numbers of bins in `sizes` as the base has them."
        )
    parts, begin = [], 0
    for axes in (TRANSLATION, ROTATION):
        shape = old.n_bins[axes]
        n = shape[0] * shape[1] * shape[2]
        cube = table[begin : begin + n].double().reshape(*shape, -1)
        for place, axis in enumerate(range(axes.start, axes.stop)):
            weights = _weights(old.centres(axis, table.device), new.centres(axis, table.device))
            cube = torch.tensordot(weights, cube.movedim(place, 0), dims=1).movedim(0, place)
        parts.append(cube.reshape(n, -1))
        begin += n
    return torch.cat([*parts, table[begin:].double()]).to(table.dtype)


def _weights(old: Tensor, new: Tensor) -> Tensor:
    """Return (n, n): how much each old bin counts in each new one; rows sum to 1."""
    places = new.clamp(old[0], old[-1])
    right = torch.bucketize(places, old, right=True).clamp(1, len(old) - 1)
    share = (places - old[right - 1]) / (old[right] - old[right - 1])
    weights = torch.zeros(len(new), len(old), dtype=old.dtype, device=old.device)
    weights.scatter_(1, (right - 1)[:, None], (1 - share)[:, None])
    return weights.scatter_(1, right[:, None], share[:, None])
