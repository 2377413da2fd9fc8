"""Vectors that are a state, and those that are none."""

import numpy as np
import pytest

from tests.wire.hostile_numbers import hostile_vectors
from vla_eval.features import STATE_NAMES, rotation_columns
from vla_eval.wire.noise import SEEDS, look_at, noise_state
from vla_eval.wire.numbers import NumbersError, as_state

QUATERNIONS = {
    "zero": (0, 0, 0, 0),
    "minus zero": (-0.0, 0, 0, 0),
    "tiny": (1e-30, 0, 0, 0),
    "subnormal": (1e-45, 0, 0, 0),
    "half": (0.5, 0, 0, 0),
    "one per cent and a bit too long": (1.011, 0, 0, 0),
    "long": (1, 1, 1, 1),
    "huge": (1e38, 1e38, 1e38, 1e38),
}


def joints(quaternion: tuple[float, ...] = (0, 1, 0, 0)) -> np.ndarray:
    state = np.zeros(25, dtype=np.float32)
    state[3:7] = quaternion
    return state


def eef(quaternion: tuple[float, ...] = (0, 1, 0, 0)) -> np.ndarray:
    columns = rotation_columns(np.array(quaternion, dtype=np.float32))
    return np.array([0.1, 0, 0.2, *columns, 0.04], dtype=np.float32)


@pytest.mark.parametrize(("kind", "good"), [("joints", joints()), ("eef", eef())])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_state_is_taken_and_becomes_float32(kind: str, good: np.ndarray, dtype: type) -> None:
    taken = as_state(good.astype(dtype), STATE_NAMES[kind])  # type: ignore[index]
    np.testing.assert_array_equal(taken, good)
    assert taken.dtype == np.float32 and not np.shares_memory(taken, good)


@pytest.mark.parametrize(("kind", "good"), [("joints", joints()), ("eef", eef())])
def test_numbers_that_are_not_finite_and_other_types_are_refused(kind: str, good: np.ndarray) -> None:
    for name, bad in hostile_vectors(good):
        with pytest.raises(NumbersError, match="expected"):
            as_state(bad, STATE_NAMES[kind])  # type: ignore[index]
            raise AssertionError(name)
    for bad in (good[:-1], np.append(good, good[:1]), good[None], np.float32(1), 1.0, None):
        with pytest.raises(NumbersError, match="expected an array"):
            as_state(bad, STATE_NAMES[kind])  # type: ignore[index]


@pytest.mark.parametrize("quaternion", QUATERNIONS.values(), ids=QUATERNIONS)
def test_a_quaternion_that_is_no_rotation_is_refused(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(NumbersError, match="expected a quaternion, of length 1, in qw, qx, qy, qz; found"):
        as_state(joints(quaternion), STATE_NAMES["joints"])


@pytest.mark.parametrize("first", [3, 6])
@pytest.mark.parametrize("length", [0, 1e-30, 0.98, 1.02, 1e38])
def test_columns_of_a_rotation_that_are_none_are_refused(first: int, length: float) -> None:
    state = eef()
    state[first : first + 3] = (length, 0, 0)
    with pytest.raises(NumbersError, match="expected a column of a rotation matrix"):
        as_state(state, STATE_NAMES["eef"])


def test_a_rotation_may_be_rounded_to_two_decimals_and_have_any_sign() -> None:
    generator = np.random.default_rng(0)
    for _ in range(200):
        quaternion = generator.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        as_state(joints(tuple(np.round(quaternion, 2))), STATE_NAMES["joints"])
        as_state(joints(tuple(-quaternion)), STATE_NAMES["joints"])


@pytest.mark.parametrize("kind", ["joints", "eef"])
def test_noise_is_a_state(kind: str) -> None:
    for seed in range(100):
        noise = noise_state(np.random.default_rng(seed), seed % 4, STATE_NAMES[kind])  # type: ignore[index]
        np.testing.assert_array_equal(as_state(noise, STATE_NAMES[kind]), noise)  # type: ignore[index]


@pytest.mark.parametrize("chunk_size", [1, 2, 4, 8, 50])
def test_episodes_of_a_check_look_different_at_each_step_and_in_all_ways_within_four_inferences(
    chunk_size: int,
) -> None:
    for step in range(4 * chunk_size):
        assert {look_at(seed, step, chunk_size) for seed in SEEDS} == {0, 1, 2, 3}
    for seed in SEEDS:
        assert {look_at(seed, k * chunk_size, chunk_size) for k in range(4)} == {0, 1, 2, 3}
