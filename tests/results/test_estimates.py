"""Estimates against numbers derived by hand."""

import math
import subprocess
import sys

import numpy as np
import pytest

from vla_eval.results.estimates import (
    Interval,
    PairCounts,
    chance_corrected,
    estimate_runs,
    holm,
    mcnemar_exact,
    paired_interval,
    wilson_interval,
)

Z = 1.959963984540054  # 97.5 % quantile of the normal distribution, from a table


@pytest.mark.parametrize(("n_success", "n"), [(8, 10), (0, 20), (100, 100), (33, 100), (1, 1)])
def test_the_wilson_interval_is_the_one_of_the_formula(n_success: int, n: int) -> None:
    # Centre and half width as Wilson gives them:
    # (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n)
    p = n_success / n
    centre = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2)) / (1 + Z**2 / n)
    assert wilson_interval(n_success, n) == pytest.approx((centre - half, centre + half), abs=1e-9)


def test_the_wilson_interval_of_8_of_10_is_the_textbook_one() -> None:
    # p = 0.8, n = 10, z² = 3.8415: centre (0.8 + 0.19207)/1.38415 = 0.71674;
    # half 1.95996 sqrt(0.016 + 0.0096037)/1.38415 = 0.22657.
    assert wilson_interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)


def test_the_wilson_interval_of_nothing_is_undefined() -> None:
    assert wilson_interval(0, 0) is None


def test_all_failures_leave_room_above_zero() -> None:
    # For 0 of n the formula shrinks to [0, z²/(n + z²)] = 3.8415/103.8415.
    assert wilson_interval(0, 100) == pytest.approx((0.0, 0.036994), abs=1e-6)


def test_three_runs_give_mean_sem_and_a_t_interval() -> None:
    # Run means 0.5, 0.6, 0.7: mean 0.6; variance (0.01 + 0 + 0.01)/2 = 0.01; SEM 0.1/sqrt(3) = 0.057735;
    # t quantile with 2 degrees of freedom 4.302653 (table): half width 0.248414.
    found = estimate_runs([0.5, 0.6, 0.7])
    assert found is not None and found.interval is not None
    assert found.mean == pytest.approx(0.6)
    assert found.sem == pytest.approx(0.0577350, abs=1e-7)
    assert found.interval == pytest.approx((0.351586, 0.848414), abs=1e-6)


def test_the_t_interval_stays_within_0_and_1() -> None:
    # Run means 0.9 and 1.0: SEM 0.05, t quantile with 1 degree of freedom 12.706: half width 0.635.
    found = estimate_runs([0.9, 1.0])
    assert found is not None
    assert found.interval == pytest.approx((0.95 - 12.7062 * 0.05, 1.0), abs=1e-4)
    low = estimate_runs([0.0, 0.1])
    assert low is not None and low.interval is not None
    assert low.interval.low == 0.0


def test_one_run_has_no_sem() -> None:
    found = estimate_runs([0.4])
    assert found is not None
    assert (found.mean, found.sem, found.interval) == (0.4, None, None)


def test_no_run_has_no_mean() -> None:
    assert estimate_runs([]) is None


def test_equal_runs_have_a_sem_of_exactly_zero() -> None:
    found = estimate_runs([0.1, 0.1, 0.1])  # 0.1 + 0.1 + 0.1 is not 0.3 in floating point
    assert found is not None
    assert (found.mean, found.sem, found.interval) == (0.1, 0.0, Interval(0.1, 0.1))


def test_mcnemar_is_the_binomial_tail_of_the_pairs_that_differ() -> None:
    # b = 7, c = 1: p = 2 (C(8,0) + C(8,1)) / 2^8 = 2 * 9 / 256 = 0.0703125.
    found = mcnemar_exact(PairCounts(both=5, only_first=7, only_second=1, neither=7))
    assert found is not None
    assert found.p_value == pytest.approx(0.0703125)
    assert found.difference == pytest.approx(6 / 20)


def test_mcnemar_has_no_direction() -> None:
    one = mcnemar_exact(PairCounts(both=0, only_first=9, only_second=2, neither=0))
    other = mcnemar_exact(PairCounts(both=0, only_first=2, only_second=9, neither=0))
    assert one is not None and other is not None
    assert one.p_value == pytest.approx(other.p_value)
    assert one.difference == -other.difference


@pytest.mark.parametrize("counts", [PairCounts(10, 0, 0, 10), PairCounts(0, 3, 3, 0)])
def test_policies_that_differ_in_no_direction_have_p_1(counts: PairCounts) -> None:
    found = mcnemar_exact(counts)
    assert found is not None
    assert found.p_value == 1.0 and found.difference == 0.0


def test_mcnemar_of_no_pair_is_undefined() -> None:
    assert mcnemar_exact(PairCounts(0, 0, 0, 0)) is None


def test_holm_multiplies_the_smallest_by_their_number_and_keeps_the_order() -> None:
    # Sorted 0.01, 0.02, 0.04 (m = 3): 3*0.01 = 0.03; max(0.03, 2*0.02) = 0.04; max(0.04, 0.04) = 0.04.
    assert holm([0.04, 0.01, 0.02]) == pytest.approx((0.04, 0.03, 0.04))


def test_holm_never_passes_1() -> None:
    assert holm([0.9, 0.8]) == pytest.approx((1.0, 1.0))


@pytest.mark.parametrize("p_values", [(), (0.03,)])
def test_holm_of_one_or_none_changes_nothing(p_values: tuple[float, ...]) -> None:
    assert holm(p_values) == p_values


def test_a_score_is_placed_between_chance_and_ceiling() -> None:
    # (0.6 - 0.3) / (0.9 - 0.3) = 0.5
    assert chance_corrected(0.6, chance=0.3, ceiling=0.9) == pytest.approx(0.5)
    assert chance_corrected(0.0, chance=0.5, ceiling=1.0) == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("score", "chance", "ceiling"),
    [(None, 0.3, 0.9), (0.5, None, 0.9), (0.5, 0.3, None), (0.5, 0.5, 0.5), (0.5, 0.6, 0.5)],
)
def test_a_score_without_room_above_chance_is_undefined(
    score: float | None, chance: float | None, ceiling: float | None
) -> None:
    assert chance_corrected(score, chance=chance, ceiling=ceiling) is None


def test_estimates_import_neither_torch_nor_pandas() -> None:
    code = (
        "import sys, vla_eval.results.estimates\n"
        "print([name for name in ('torch', 'lerobot', 'pandas', 'cv2') if name in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert output.stdout.strip() == "[]"


# ------------------------------------------------------------------------------- interval of a difference


def test_the_interval_of_a_difference_is_the_one_of_the_formula() -> None:
    # 10 both, 15 only the first, 5 only the second, 20 neither: rates 25/50 and 15/50.
    # Wilson with z²/n = 0.076829: of 0.5: centre 0.5, half 0.133550; of 0.3: (0.3 + 0.038415)/1.076829 =
    # 0.314270, half 0.123171, so 0.191099 to 0.437441. φ = (10 · 20 - 15 · 5 - 25)/√(25 · 25 · 15 · 35)
    # = 100/572.8220 = 0.174574, with n/2 = 25 taken off.
    # Below: √(0.133550² - 2φ · 0.133550 · 0.137441 + 0.137441²); above: the same with 0.108901.
    below = math.sqrt(0.133550**2 - 2 * 0.174574 * 0.133550 * 0.137441 + 0.137441**2)
    above = math.sqrt(0.133550**2 - 2 * 0.174574 * 0.133550 * 0.108901 + 0.108901**2)
    found = paired_interval(PairCounts(both=10, only_first=15, only_second=5, neither=20))
    assert found == pytest.approx((0.2 - below, 0.2 + above), abs=1e-4)


def test_the_interval_of_a_difference_has_no_preferred_side() -> None:
    one = paired_interval(PairCounts(both=7, only_first=9, only_second=2, neither=4))
    other = paired_interval(PairCounts(both=7, only_first=2, only_second=9, neither=4))
    assert (one.low, one.high) == pytest.approx((-other.high, -other.low))


@pytest.mark.parametrize("counts", [PairCounts(20, 0, 0, 0), PairCounts(0, 20, 0, 0), PairCounts(0, 0, 0, 1)])
def test_outcomes_that_never_vary_have_an_interval_of_some_width(counts: PairCounts) -> None:
    low, high = paired_interval(counts)
    assert -1 <= low < high <= 1


def test_the_interval_of_a_difference_holds_it_as_often_as_promised() -> None:
    rng, n = np.random.default_rng(0), 20
    # Success 0.9 and 0.35, independent: the situation of a policy against chance.
    shares = (0.9 * 0.35, 0.9 * 0.65, 0.1 * 0.35, 0.1 * 0.65)
    draws = rng.multinomial(n, shares, 1000)
    covered = 0
    for draw in draws:
        low, high = paired_interval(PairCounts(*map(int, draw)))
        covered += low <= 0.55 <= high
    assert covered / 1000 > 0.93  # 0.95, less three standard errors of 1000 draws
