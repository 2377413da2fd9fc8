"""How an arm moved in an episode, from the poses of its tool centre point. Knows nothing of simulators."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_eval.strict.bounds import Distance

MOVES_M, TURNS_RAD = 1e-4, 1e-3
"""A control step in which the arm moves or turns less counts as rest: 2 mm/s and 1.1 °/s at 20 Hz."""

HELD = -1
"""In place of the step of the inference behind a control step, where the arm held still for want of one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How smooth an episode was; None where there is nothing to measure.

    A *border* is a control step whose action comes from another chunk than the action before, or after which
    holding begins or ends; the wait for the first chunk has none. The *jump* of a control step is how much
    the arm's way in it differs from its way in the step before, as a vector: 0 at constant velocity.
    """

    border_jump_m: Distance | None  # mean of the jumps at borders
    border_jump_rad: Distance | None  # likewise, of rotations
    # median way of a control step in which the arm moves; the measure for jumps
    median_step_m: Distance | None
    median_step_rad: Distance | None
    # root mean square of the third time derivative of the position, m/s³
    jerk_m_s3: Distance | None


def motion_of(
    poses: Sequence[NDArray[np.float32]], inferred_at_steps: Sequence[int], *, control_hz: float
) -> Motion:
    """Measure an episode of N control steps.

    Args:
        poses: N + 1 poses (7,): position in m, wxyz quaternion, world frame; the first before the first step.
        inferred_at_steps: of each control step, the step of the observation behind its action, or `HELD`.
        control_hz: control steps per second.
    """
    path = np.stack(poses).astype(np.float64)
    ways_m = np.diff(path[:, :3], axis=0)
    turns_rad = _turns_rad(path[:, 3:])
    borders = _borders(inferred_at_steps)
    jerks = np.diff(path[:, :3], n=3, axis=0) * control_hz**3
    return Motion(
        border_jump_m=_jump(ways_m, borders),
        border_jump_rad=_jump(turns_rad, borders),
        median_step_m=_median(ways_m, above=MOVES_M),
        median_step_rad=_median(turns_rad, above=TURNS_RAD),
        jerk_m_s3=float(np.sqrt((jerks**2).sum(axis=1).mean())) if len(jerks) else None,
    )


def _borders(inferred_at_steps: Sequence[int]) -> list[int]:
    first = next((i for i, one in enumerate(inferred_at_steps) if one != HELD), len(inferred_at_steps))
    after = range(first + 1, len(inferred_at_steps))
    return [step for step in after if inferred_at_steps[step] != inferred_at_steps[step - 1]]


def _turns_rad(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vector (N, 3) from each orientation (N + 1, 4), wxyz, to the next, world frame."""
    w, xyz = quaternions[:, :1], quaternions[:, 1:]
    # next * conjugate of this
    real = w[1:] * w[:-1] + (xyz[1:] * xyz[:-1]).sum(axis=1, keepdims=True)
    imaginary = -w[1:] * xyz[:-1] + w[:-1] * xyz[1:] - np.cross(xyz[1:], xyz[:-1])
    sign = np.where(real < 0, -1.0, 1.0)  # the shorter way
    real, imaginary = real * sign, imaginary * sign
    length = np.linalg.norm(imaginary, axis=1, keepdims=True)
    angle = 2 * np.arctan2(length, real)
    vectors: NDArray[np.float64] = imaginary * (angle / np.where(length > 0, length, 1.0))
    return vectors


def _jump(ways: NDArray[np.float64], borders: Sequence[int]) -> float | None:
    if not borders:
        return None
    at = np.array(borders)
    return float(np.linalg.norm(ways[at] - ways[at - 1], axis=1).mean())


def _median(ways: NDArray[np.float64], *, above: float) -> float | None:
    lengths = np.linalg.norm(ways, axis=1)
    moving = lengths[lengths > above]
    return float(np.median(moving)) if len(moving) else None
