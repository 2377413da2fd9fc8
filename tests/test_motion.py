"""How an arm moved, on paths whose jumps and jerks are known beforehand."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vla_eval.motion import HELD, motion_of

HZ = 20.0


def poses(
    positions_m: Sequence[Sequence[float]], turns: Sequence[Rotation] | None = None
) -> list[NDArray[np.float32]]:
    rotations = turns or [Rotation.identity()] * len(positions_m)
    return [
        np.array([*position, *np.roll(turn.as_quat(), 1)], dtype=np.float32)  # scipy's are xyzw
        for position, turn in zip(positions_m, rotations, strict=True)
    ]


def test_an_arm_at_constant_velocity_has_no_jump_and_no_jerk() -> None:
    found = motion_of(poses([(0.01 * i, 0, 0) for i in range(9)]), [0, 0, 2, 2, 4, 4, 6, 6], control_hz=HZ)

    assert found.border_jump_m == pytest.approx(0, abs=1e-7)
    assert found.median_step_m == pytest.approx(0.01, rel=1e-5)
    assert found.jerk_m_s3 == pytest.approx(0, abs=1e-2)  # 1e-8 m of rounding x 8,000
    assert found.border_jump_rad == pytest.approx(0, abs=1e-6)
    assert found.median_step_rad is None  # it never turns


def test_a_jump_is_the_change_of_the_way_at_a_border_as_a_vector() -> None:
    # Ways: +x, +x, then +y, +y: at the border of step 2 the way changes by (-0.01, 0.01, 0).
    path = [(0, 0, 0), (0.01, 0, 0), (0.02, 0, 0), (0.02, 0.01, 0), (0.02, 0.02, 0)]

    found = motion_of(poses(path), [0, 0, 2, 2], control_hz=HZ)

    assert found.border_jump_m == pytest.approx(0.01 * math.sqrt(2), rel=1e-5)


def test_holding_begins_and_ends_at_borders_but_waiting_for_the_first_chunk_is_none() -> None:
    # Still, +x, +x, still, +x: borders are steps 3 and 4; the way changes by 0.01 at both.
    path = [(x, 0, 0) for x in (0, 0, 0.01, 0.02, 0.02, 0.03)]

    found = motion_of(poses(path), [HELD, 0, 0, HELD, 3], control_hz=HZ)

    assert found.border_jump_m == pytest.approx(0.01, rel=1e-5)


def test_one_chunk_has_no_border() -> None:
    found = motion_of(poses([(0, 0, 0), (0.01, 0, 0)]), [0], control_hz=HZ)

    assert (found.border_jump_m, found.border_jump_rad, found.jerk_m_s3) == (None, None, None)


def test_an_arm_that_rests_has_no_median_step() -> None:
    found = motion_of(poses([(0, 0, 0)] * 5), [0, 0, 2, 2], control_hz=HZ)

    assert (found.median_step_m, found.border_jump_m) == (None, 0.0)


def test_rest_is_not_counted_in_the_median_step() -> None:
    path = [(x, 0, 0) for x in (0, 0, 0, 0, 0, 0.01, 0.03)]

    assert motion_of(poses(path), [0] * 6, control_hz=HZ).median_step_m == pytest.approx(0.015, rel=1e-5)


def test_jerk_is_the_third_derivative_in_seconds() -> None:
    # x = t³ has the third derivative 6 everywhere, and so has its third difference.
    path = [((i / HZ) ** 3, 0, 0) for i in range(20)]

    assert motion_of(poses(path), [0] * 19, control_hz=HZ).jerk_m_s3 == pytest.approx(6, rel=1e-3)


def test_turns_are_rotation_vectors_whatever_the_sign_of_the_quaternion() -> None:
    random = np.random.default_rng(0)
    turns = [Rotation.from_rotvec(random.normal(size=3) * 0.8) for _ in range(7)]
    given = poses([(0, 0, 0)] * 7, turns)
    for pose in given[::2]:
        pose[3:] *= -1
    ways = np.stack([(b * a.inv()).as_rotvec() for a, b in itertools.pairwise(turns)])
    jumps = np.linalg.norm(np.diff(ways, axis=0), axis=1)

    found = motion_of(given, [0, 0, 2, 2, 4, 4], control_hz=HZ)

    assert found.border_jump_rad == pytest.approx((jumps[1] + jumps[3]) / 2, rel=1e-5)
    assert found.median_step_rad == pytest.approx(np.median(np.linalg.norm(ways, axis=1)), rel=1e-5)
