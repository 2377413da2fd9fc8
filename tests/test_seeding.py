import numpy as np
import pytest
from scipy.stats import chisquare

from vla_eval.seeding import SeedRange, Stream, generator, seed_ranges

N_SEEDS = 3000


def test_same_seed_and_purpose_give_the_same_draws_whatever_was_drawn_before() -> None:
    expected = generator(7, Stream.LAYOUT).uniform(size=4)
    generator(7, Stream.TARGET).uniform(size=100)
    assert np.array_equal(generator(7, Stream.LAYOUT).uniform(size=4), expected)
    assert not np.array_equal(generator(7, Stream.TARGET).uniform(size=4), expected)
    assert not np.array_equal(generator(8, Stream.LAYOUT).uniform(size=4), expected)
    assert not np.array_equal(generator(7, Stream.LAYOUT, 1).uniform(size=4), expected)


@pytest.mark.parametrize("n_items", [3, 5, 9])
def test_target_and_its_place_are_uniform_and_independent_over_seeds(n_items: int) -> None:
    joint = np.zeros((n_items, n_items))
    for seed in range(1, N_SEEDS + 1):
        target = int(generator(seed, Stream.TARGET).integers(n_items))
        order = generator(seed, Stream.PERMUTATION).permutation(n_items)
        joint[target, order[target]] += 1
    # Under uniformity and independence every cell expects N / n²; a fair draw fails once in 10,000.
    assert chisquare(joint.ravel()).pvalue > 1e-4
    assert chisquare(joint.sum(axis=1)).pvalue > 1e-4


def test_ranges_hold_exactly_the_seeds_and_are_as_few_as_can_be() -> None:
    ranges = seed_ranges([7, 3, 4, 5, 4, 9])
    assert ranges == (SeedRange(first=3, last=5), SeedRange(first=7, last=7), SeedRange(first=9, last=9))
    assert [seed for seed in range(12) if any(seed in one for one in ranges)] == [3, 4, 5, 7, 9]
    assert seed_ranges([]) == ()
