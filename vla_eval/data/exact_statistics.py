"""Statistics over all frames of a dataset, exact, in lerobot's form.

lerobot 0.6.1 averages the quantiles of the episodes: of a state that is constant per episode, 0 to 9,
it makes q01 = q99 = 4.5. Here numbers come from all rows, and those of images from histograms of all raw
pixels. A normalisation cannot divide by each of them: `usable_statistics` is the one rule for that.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple  # Any: lerobot's plain data

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import POSITION
from vla_eval.core import ImageArray
from vla_eval.features import ACTION_KEY, FPS, STATE_KEY

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
N_LEVELS = 256  # of a uint8 channel
N_CHANNELS = 3

RESOLUTION = 1e-3
"""Least spread that a normalisation divides by: of a position (m), an angle (rad), a component of a rotation
(which changes by at most its angle) and of a command in [-1, 1].

A contact of 1 N moves the Panda by it: its stiffness is 1e3 N/m at a finger, and 1e3 N m/rad at a joint, with
a reach of 0.86 m. A command of 1 is 0.1 m per step, so that this is 0.1 mm; independent errors of 100 steps
add up to ten times that, 1 mm. Numbers of unknown unit have it, too: it keeps what is constant from being
divided by 0. Source:
https://github.com/haosulab/ManiSkill/blob/628bbe64e2c925d9d543171361a86c4a4965c6e9/mani_skill/agents/robots/panda/panda.py
"""
MOTOR_RESOLUTION = 360 / 4096
"""The same of a motor's position in LeRobot's numbers: a step of an STS3215's encoder, in degrees.
Source: its 4,096 steps per turn, as in `lerobot.motors.feetech.tables.MODEL_RESOLUTION`."""
VELOCITY = "_velocity"  # end of the name of what has the unit 1/s; the others are per control step
RANGES = (("min", "max"), ("q01", "q99"), ("q10", "q90"))

Histogram = NDArray[np.int64]
"""(3, 256): how many pixels of a channel have a level."""

Statistics = dict[str, NDArray[np.float64]]
"""`min`, `max`, `mean`, `std`, `count`, `q01` … `q99`; arrays, as lerobot has them."""

_Fields = Mapping[str, Mapping[str, Any]]  # Any: lerobot's plain data


def empty_histogram() -> Histogram:
    """Return a histogram of nothing."""
    return np.zeros((N_CHANNELS, N_LEVELS), dtype=np.int64)


def count_levels(image: ImageArray) -> Histogram:
    """Return the histogram of an (H, W, 3) uint8 image."""
    flat = image.reshape(-1, N_CHANNELS)
    return np.stack([np.bincount(flat[:, channel], minlength=N_LEVELS) for channel in range(N_CHANNELS)])


def vector_statistics(rows: NDArray[np.generic]) -> Statistics:
    """Return the statistics of (N, D) numbers, per column, in float64."""
    values = rows.astype(np.float64)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **{name: np.quantile(values, q, axis=0) for name, q in QUANTILES.items()},
    }


def image_statistics(histogram: Histogram, *, n_frames: int) -> Statistics:
    """Return the statistics of a camera, levels scaled to [0, 1]; each value is (3, 1, 1), but `count`."""
    levels = np.arange(N_LEVELS) / (N_LEVELS - 1)
    total = histogram.sum(axis=1)
    weights = histogram / histogram.sum(axis=1, keepdims=True)
    mean = weights @ levels
    variance = (weights * (levels[None] - mean[:, None]) ** 2).sum(axis=1)
    cumulated = histogram.cumsum(axis=1)

    def level_at(share: float) -> NDArray[np.float64]:
        rank = share * (total - 1)  # numpy's definition, by the lower neighbour
        reached: NDArray[np.float64] = levels[(cumulated > rank[:, None]).argmax(axis=1)]
        return reached

    present = histogram > 0
    by_name = {
        "min": levels[present.argmax(axis=1)],
        "max": levels[N_LEVELS - 1 - present[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(variance),
        **{name: level_at(q) for name, q in QUANTILES.items()},
    }
    shaped = {name: value.reshape(N_CHANNELS, 1, 1) for name, value in by_name.items()}
    return {**shaped, "count": np.array([n_frames])}


def usable_statistics(statistics: _Fields | None, features: _Fields) -> dict[str, dict[str, Any]]:
    """Return statistics that a normalisation can divide by; other fields than state and action as they are.

    docs/datasets.md has the rule. Quantiles that are nearer to their middle than the standard deviation are
    replaced by minimum and maximum, which are never nearer (Popoviciu 1935).
    """
    usable = {key: dict(values) for key, values in (statistics or {}).items()}
    for field in _fields(statistics, features):
        ranges: dict[str, NDArray[np.float64]] = {}
        for low, high in (names for names in RANGES if field.has(*names)):
            rare = field.is_rare(low, high)
            first = np.where(rare, field.found.get("min", 0), field.found[low])
            last = np.where(rare, field.found.get("max", 0), field.found[high])
            middle, half = (first + last) / 2, (last - first) / 2
            still = half < field.resolution
            ranges[low] = np.where(still, middle - field.resolution, first)
            ranges[high] = np.where(still, middle + field.resolution, last)
        usable[field.key] |= {"std": np.maximum(field.found["std"], field.resolution), **ranges}
    return usable


def about_still_dimensions(statistics: _Fields | None, features: _Fields) -> Iterator[str]:
    """Yield lines for a person on the dimensions whose statistics `usable_statistics` changes."""
    still: list[str] = []
    rare: list[str] = []
    for field in _fields(statistics, features):
        moves_rarely = field.is_rare("q01", "q99")
        is_still = (field.found["std"] < field.resolution) & ~moves_rarely
        named = [f"{name} {std:.2g}" for name, std in zip(field.names, field.found["std"], strict=True)]
        for lines, chosen, names in ((still, is_still, named), (rare, moves_rarely, field.names)):
            if chosen.any():
                lines.append(f"{field.key} {', '.join(np.array(names)[chosen])}")
    if still:
        motors = f", of motors {MOTOR_RESOLUTION:.2g}" if any(POSITION in line for line in still) else ""
        yield (
            f"hardly move in these demonstrations; a policy that normalises takes their deviation as "
            f"{RESOLUTION:g} (of velocities {RESOLUTION * FPS:g}){motors}: {'; '.join(still)}"
        )
    if rare:
        yield (
            f"move in few of these frames; a policy that normalises by quantiles takes minimum and maximum: "
            f"{'; '.join(rare)}"
        )


class _Field(NamedTuple):
    key: str
    names: list[str]
    found: dict[str, NDArray[np.float64]]
    resolution: NDArray[np.float64]

    def has(self, *names: str) -> bool:
        return all(name in self.found for name in names)

    def half(self, low: str, high: str) -> NDArray[np.float64]:
        return (self.found[high] - self.found[low]) / 2

    def is_rare(self, low: str, high: str) -> NDArray[np.bool_]:
        """Return (D,): whether the standard deviation comes from frames beyond a range of quantiles."""
        if not self.has(low, high, "min", "max"):
            return np.zeros(len(self.names), dtype=np.bool_)
        farthest = self.half("min", "max")  # in theory never nearer than the deviation
        nearer = self.half(low, high) < np.minimum(self.found["std"], farthest)
        return np.asarray(nearer & (farthest >= self.resolution), dtype=np.bool_)


def _fields(statistics: _Fields | None, features: _Fields) -> Iterator[_Field]:
    known = statistics or {}
    for key in (key for key in (STATE_KEY, ACTION_KEY) if "std" in known.get(key, {})):
        found = {name: np.asarray(values, dtype=np.float64) for name, values in known[key].items()}
        names, n_dims = features.get(key, {}).get("names"), len(found["std"])
        if not isinstance(names, list | tuple) or len(names) != n_dims:  # of another program
            names = range(n_dims)
        named = [str(name) for name in names]
        yield _Field(key, named, found, np.array([_resolution(name) for name in named]))


def _resolution(name: str) -> float:
    if name.endswith(POSITION):
        return MOTOR_RESOLUTION
    return RESOLUTION * (FPS if name.endswith(VELOCITY) else 1)
