"""Dimensions that hardly move: what a normalisation divides by, and how they are named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep
from numpy.typing import NDArray

from vla_eval.control_modes import CONTROL_MODES
from vla_eval.data import exact_statistics
from vla_eval.data.exact_statistics import (
    RESOLUTION,
    about_still_dimensions,
    usable_statistics,
    vector_statistics,
)
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.sharing.card import write_card
from vla_eval.features import ACTION_KEY, STATE_KEY, STATE_NAMES
from vla_eval.models.shared.normalization import Normalization, Normalizer, mask_all_but
from vla_eval.models.shared.step_names import STATISTICS

N_FRAMES = 1000
MODES = [mode for mode in NormalizationMode if mode != NormalizationMode.IDENTITY]
MOST_MEAN_SQUARE = 5 + 1e-3  # half >= std, |mean - median| <= std, the median lies in the range: 1 + 2 * 2


def noise(random: np.random.Generator, size: float) -> NDArray[np.float64]:
    return random.standard_normal(N_FRAMES) * size


def rare(random: np.random.Generator, size: float) -> NDArray[np.float64]:
    """Rests, and lies elsewhere in one frame of a hundred at most."""
    moved = random.random(N_FRAMES) < random.choice([1, 3, 10, 20]) / N_FRAMES
    moved[0] = True
    return np.where(moved, size, 0.0)


def steps(random: np.random.Generator, size: float) -> NDArray[np.float64]:
    return size * (np.arange(N_FRAMES) % 2)


def heavy(random: np.random.Generator, size: float) -> NDArray[np.float64]:
    return np.clip(random.standard_cauchy(N_FRAMES), -1e3, 1e3) * size


KINDS: list[Callable[[np.random.Generator, float], NDArray[np.float64]]] = [noise, rare, steps, heavy]


def statistics_of(
    rows: NDArray[np.float64], *, key: str = STATE_KEY, names: tuple[str, ...] | None = None
) -> tuple[dict[str, dict[str, NDArray[np.float64]]], dict[str, dict[str, object]]]:
    features: dict[str, dict[str, object]] = {key: {"names": list(names) if names else None}}
    return {key: vector_statistics(rows)}, features


def lerobots(
    step: type, rows: NDArray[np.float64], stats: object, mode: NormalizationMode, values: torch.Tensor
) -> torch.Tensor:
    """Return values (…, D) through lerobot's own (un)normalizer of actions."""
    feature = {ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(rows.shape[1],))}
    made = step(features=feature, norm_map={FeatureType.ACTION: mode}, stats=stats)
    result: torch.Tensor = made._normalize_action(values, inverse=step is UnnormalizerProcessorStep)
    return result


@settings(deadline=None, max_examples=80)
@given(
    kind=st.sampled_from(KINDS),
    size=st.sampled_from([0.0, 1e-7, 2.3e-6, 1e-4, 1e-3, 0.02, 1.0, 50.0]),
    at=st.sampled_from([0.0, 0.08, -1.0, 1.0]),
    mode=st.sampled_from(MODES),
    seed=st.integers(0, 1000),
)
def test_no_kind_of_motion_is_blown_up_by_any_of_lerobots_normalisations(
    kind: Callable[[np.random.Generator, float], NDArray[np.float64]],
    size: float,
    at: float,
    mode: NormalizationMode,
    seed: int,
) -> None:
    rows = (at + kind(np.random.default_rng(seed), size)).reshape(-1, 1).astype(np.float32)
    stats = usable_statistics(*statistics_of(rows.astype(np.float64), key=ACTION_KEY, names=("dx",)))

    values = torch.tensor(rows)
    normalized = lerobots(NormalizerProcessorStep, rows, stats, mode, values)
    moved = lerobots(NormalizerProcessorStep, rows, stats, mode, values + RESOLUTION)

    assert float((normalized.double() ** 2).mean()) <= MOST_MEAN_SQUARE
    assert float((moved - normalized).abs().max()) <= 1.01
    back = lerobots(UnnormalizerProcessorStep, rows, stats, mode, normalized)
    assert torch.allclose(back, values, atol=1e-5 * max(1.0, float(values.abs().max())))


@settings(deadline=None, max_examples=40)
@given(
    kind=st.sampled_from(KINDS),
    size=st.sampled_from([0.0, 2.3e-6, 1e-3, 1.0]),
    name=st.sampled_from(sorted(STATISTICS)),
    seed=st.integers(0, 1000),
)
def test_nor_by_our_own_and_what_is_cut_can_still_be_said(
    kind: Callable[[np.random.Generator, float], NDArray[np.float64]], size: float, name: str, seed: int
) -> None:
    rows = kind(np.random.default_rng(seed), size).reshape(-1, 1)
    stats = usable_statistics(*statistics_of(rows, key=ACTION_KEY, names=("dx",)))
    spec = Normalization(kind=name, mask=mask_all_but(1), clip=False)  # type: ignore[arg-type]
    normalizer = Normalizer(spec, stats[ACTION_KEY], where="a test")

    normalized = normalizer.normalize(torch.tensor(rows))

    assert float((normalized.double() ** 2).mean()) <= MOST_MEAN_SQUARE
    if kind is rare and name == "q01_q99" and size > RESOLUTION:  # both values are inside of what is cut
        assert normalized.abs().max() <= 1 + 1e-6


@pytest.mark.parametrize("size", [0.05, 0.5, 2.0])
def test_what_moves_is_left_as_it_is(size: float) -> None:
    rows = np.random.default_rng(0).standard_normal((N_FRAMES, 3)) * size
    given_statistics, features = statistics_of(rows)

    usable = usable_statistics(given_statistics, features)

    for name, values in given_statistics[STATE_KEY].items():
        assert np.array_equal(usable[STATE_KEY][name], values), name
    assert not list(about_still_dimensions(given_statistics, features))


def test_facts_and_other_fields_are_not_touched() -> None:
    rows = np.full((10, 2), 0.5)
    stats, features = statistics_of(rows)
    stats["observation.images.base"] = vector_statistics(np.zeros((10, 3)))

    usable = usable_statistics(stats, features)

    assert np.all(stats[STATE_KEY]["std"] == 0)
    assert np.all(usable["observation.images.base"]["std"] == 0)
    assert np.array_equal(usable[STATE_KEY]["mean"], stats[STATE_KEY]["mean"])


def test_a_tenth_of_a_millimetre_of_gripper_width_is_a_tenth_of_a_deviation() -> None:
    # Of shipped demonstrations: the width is 80 mm, with a standard deviation of 2.3 µm.
    rows = 0.08 + 2.3e-6 * np.random.default_rng(0).standard_normal((N_FRAMES, 1))

    usable = usable_statistics(*statistics_of(rows, names=("gripper_width",)))

    assert 1e-4 / usable[STATE_KEY]["std"] == pytest.approx(0.1)


def test_velocities_are_per_second_and_not_per_step() -> None:
    names = ("joint1", "joint1_velocity")

    usable = usable_statistics(*statistics_of(np.zeros((10, 2)), names=names))

    assert usable[STATE_KEY]["std"] == pytest.approx([1e-3, 2e-2])  # 1 mrad; 1 mrad in 1/20 s


def test_a_gripper_that_moves_in_one_frame_of_a_thousand_has_the_range_of_its_two_positions() -> None:
    # LeRobot would divide by 1e-8: (2 / 1e-8)² = 4e16 in the loss.
    rows = np.ones((N_FRAMES, 1))
    rows[:2] = -1

    stats = usable_statistics(*statistics_of(rows, key=ACTION_KEY, names=("gripper",)))[ACTION_KEY]

    assert (stats["q01"], stats["q99"], stats["q10"], stats["q90"]) == (-1, 1, -1, 1)


def test_a_dataset_without_statistics_has_none_that_are_usable() -> None:
    assert usable_statistics(None, {}) == {}
    assert not list(about_still_dimensions(None, {}))


def test_statistics_of_another_program_may_lack_quantiles_and_names() -> None:
    stats = {STATE_KEY: {"mean": np.zeros(2), "std": np.array([0.0, 1.0])}, ACTION_KEY: {"q01": np.zeros(2)}}
    features = {STATE_KEY: {"names": {"motors": ["a", "b"]}}}

    usable = usable_statistics(stats, features)

    assert usable[STATE_KEY]["std"] == pytest.approx([RESOLUTION, 1.0])
    (line,) = about_still_dimensions(stats, features)
    assert line.endswith(": observation.state 0 0")


@pytest.mark.parametrize("names", [*STATE_NAMES.values(), *(spec.dims for spec in CONTROL_MODES.values())])
def test_each_dimension_that_hardly_moves_is_named_with_its_deviation(names: tuple[str, ...]) -> None:
    rows = np.zeros((N_FRAMES, len(names)))
    rows[:, 0] = 2.3e-6 * (np.arange(N_FRAMES) % 2) * 2  # a standard deviation of 2.3e-6

    (line,) = about_still_dimensions(*statistics_of(rows, key=ACTION_KEY, names=names))

    assert line.endswith(f": action {names[0]} 2.3e-06, {', '.join(f'{name} 0' for name in names[1:])}")
    assert "0.001 (of velocities 0.02)" in line


def test_one_that_moves_rarely_is_named_apart() -> None:
    rows = np.random.default_rng(0).standard_normal((N_FRAMES, 2))
    rows[:, 1] = np.where(np.arange(N_FRAMES) < 2, -1, 1)

    (line,) = about_still_dimensions(*statistics_of(rows, key=ACTION_KEY, names=("dx", "gripper")))

    assert line.startswith("move in few of these frames") and line.endswith(": action gripper")


def test_a_card_names_what_hardly_moves_in_state_and_action(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exact_statistics, "RESOLUTION", 100.0)  # more than anything moves here
    meta = open_local_dataset(recorded).meta

    text = write_card(recorded)

    (line,) = (line for line in text.splitlines() if line.startswith("- hardly move"))
    for key in (STATE_KEY, ACTION_KEY):
        pairs = zip(meta.features[key]["names"], meta.stats[key]["std"], strict=True)
        assert f"{key} {', '.join(f'{name} {std:.2g}' for name, std in pairs)}" in line
