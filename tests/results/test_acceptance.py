"""Is a policy as good as claimed: the test keeps its level whenever it stops."""

import math

import numpy as np
import pytest
from scipy import integrate, stats

from vla_eval.errors import RecipeError
from vla_eval.results.claimed.acceptance import (
    Acceptance,
    Claim,
    _log_above,
    _log_below,
    decide,
    fixed_plan,
    plan,
    power,
)

# successes, episodes, loss that matters, level
TESTS = [
    Acceptance(claim=Claim(n_success=k, n_episodes=n), loss=loss, level=level)
    for k, n, loss, level in (
        (100, 100, 0.1, 0.05),
        (91, 100, 0.15, 0.05),
        (20, 20, 0.2, 0.05),
        (45, 50, 0.2, 0.1),
        (60, 200, 0.2, 0.01),
        (3, 10, 0.1, 0.2),
    )
]
MOST = 120


@pytest.mark.parametrize("test", TESTS, ids=str)
class TestTheLevelIsKept:
    def test_of_one_that_lost_as_much_at_most_half_the_level_is_accepted_at_any_time(
        self, test: Acceptance
    ) -> None:
        # At the bar itself; the other half is for a claim whose interval does not hold the rate.
        for rate in (test.bar, test.bar / 2):
            if rate > 0:
                assert power(test, rate, MOST).reproduced[-1] <= test.level / 2

    def test_of_one_as_good_at_most_half_the_level_is_found_below_at_any_time(self, test: Acceptance) -> None:
        for rate in (test.floor, (1 + test.floor) / 2):
            assert power(test, rate, MOST).below[-1] <= test.level / 2

    def test_the_interval_of_the_claim_misses_its_rate_with_half_the_level_on_either_side(
        self, test: Acceptance
    ) -> None:
        n, half = test.claim.n_episodes, test.level / 2
        for rate in (0.05, 0.3, 0.5, 0.87, 0.99):
            low, high = 0.0, 0.0
            for k in range(n + 1):
                bounds = Claim(n_success=k, n_episodes=n).bounds(half)
                weight = stats.binom.pmf(k, n, rate)
                low += weight * (bounds[0] > rate)
                high += weight * (bounds[1] < rate)
            assert low <= half + 1e-12 and high <= half + 1e-12


@pytest.mark.parametrize(("k", "n", "rate"), [(0, 1, 0.5), (3, 7, 0.8), (7, 7, 0.9), (12, 40, 0.35)])
def test_the_evidence_is_the_mean_likelihood_ratio(k: int, n: int, rate: float) -> None:
    def ratio(q: float) -> float:
        return (q / rate) ** k * ((1 - q) / (1 - rate)) ** (n - k)

    above = integrate.quad(ratio, rate, 1)[0] / (1 - rate)
    below = integrate.quad(ratio, 0, rate)[0] / rate
    one, of = np.array([k]), np.array([n])
    assert _log_above(one, of, rate)[0] == pytest.approx(math.log(above))
    assert _log_below(one, of, rate)[0] == pytest.approx(math.log(below))


def test_the_verdict_is_that_of_the_first_episode_that_has_one() -> None:
    test = TESTS[0]
    lost = decide(test, [False] * 3)
    assert lost.verdict == "below"
    assert decide(test, [False] * 3 + [True] * 500) == lost  # what comes later changes nothing
    assert decide(test, []).verdict == decide(test, [True]).verdict == "open"
    kept = decide(test, [True] * 200)
    assert (kept.verdict, kept.n_success) == ("reproduced", kept.n_episodes)
    assert decide(test, [True] * (kept.n_episodes - 1)).verdict == "open"


@pytest.mark.parametrize("test", TESTS[:4], ids=str)
def test_the_p_value_is_the_smallest_level_at_which_it_is_below(test: Acceptance) -> None:
    found = decide(test, [False] * 100)
    assert found.p_value is not None and found.p_value <= test.level
    outcomes = [False] * found.n_episodes

    def at(level: float) -> str:
        return decide(Acceptance(claim=test.claim, loss=test.loss, level=level), outcomes).verdict

    assert at(found.p_value * 1.001) == "below" and at(found.p_value * 0.999) == "open"


def test_the_plan_is_the_fewest_episodes_with_the_power_asked_for() -> None:
    for test in TESTS[:3]:
        planned = plan(test, wanted_power=0.8, most=1000)
        found = power(test, test.claim.rate, planned).reproduced
        assert found[-1] >= 0.8 and (planned == 1 or found[-2] < 0.8)
        assert (fixed_plan(test, wanted_power=0.8, most=1000) or 0) <= planned


def test_the_test_that_looks_once_is_the_exact_binomial_test() -> None:
    test = TESTS[0]  # bar 0.9, rate 1: n successes of n are shown above 0.9 when 0.9 ** n <= 0.025
    assert fixed_plan(test, wanted_power=0.8, most=1000) == math.ceil(math.log(0.025) / math.log(0.9))
    assert fixed_plan(test, wanted_power=0.8, most=10) is None


@pytest.mark.parametrize(
    ("test", "says"),
    [
        (Acceptance(claim=Claim(n_success=10, n_episodes=20)), "no number of episodes shows"),
        (Acceptance(claim=Claim(n_success=0, n_episodes=100), loss=0.2), "never succeeds"),
        (Acceptance(claim=Claim(n_success=91, n_episodes=100)), "is accepted with probability"),
    ],
)
def test_what_cannot_be_told_is_said_before_anything_runs(test: Acceptance, says: str) -> None:
    with pytest.raises(RecipeError, match=says):
        plan(test, wanted_power=0.8, most=100)


def test_the_loss_that_the_message_names_can_be_told() -> None:
    for k, n in ((10, 20), (19, 20), (50, 100), (999, 1000)):
        test = Acceptance(claim=Claim(n_success=k, n_episodes=n), loss=0.0001)
        with pytest.raises(RecipeError) as caught:
            test.check()
        loss = float(str(caught.value).split("Use a loss above ")[1].split(",")[0])
        Acceptance(claim=test.claim, loss=loss).check()


@pytest.mark.parametrize(
    "values",
    [{"loss": 0}, {"loss": 1}, {"level": 0}, {"level": 0.5}, {"loss": math.nan}, {"level": math.nan}],
)
def test_losses_and_levels_outside_their_range_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(RecipeError):
        Acceptance(claim=Claim(n_success=1, n_episodes=2), **values)


@pytest.mark.parametrize(("k", "n"), [(-1, 5), (6, 5), (0, 0)])
def test_counts_that_are_no_counts_are_refused(k: int, n: int) -> None:
    with pytest.raises(RecipeError):
        Claim(n_success=k, n_episodes=n)
