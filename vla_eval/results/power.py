"""How many episodes are needed to detect a difference between two policies. Pure functions of numbers."""

import math

from scipy import stats

from vla_eval.results.estimates import LEVEL

POWER = 0.8


def episodes_to_settle(
    difference: float, discordance: float, *, level: float = LEVEL, power: float = POWER
) -> int:
    """Return how many paired episodes a two-sided McNemar test needs to detect a difference.

    Args:
        difference: of the two success rates, in (0, 1].
        discordance: share of episodes in which the two policies differ; raised to `difference` if it is
            smaller, which is impossible.
        level: of the test, after any correction for several comparisons, in (0, 1).
        power: probability of detecting it, in (0, 1).

    Source: Connor 1987, "Sample size for testing differences in proportions for the paired-sample
    design", Biometrics 43(1):207-211, equation 3: n = (z_{1-level/2} √ψ + z_{power} √(ψ - δ²))² / δ².
    It is for the asymptotic test; the exact one needs slightly more.
    """
    psi = max(discordance, difference)
    z_level = float(stats.norm.ppf(1 - level / 2))
    z_power = float(stats.norm.ppf(power))
    root = z_level * math.sqrt(psi) + z_power * math.sqrt(psi - difference**2)
    return math.ceil((root / difference) ** 2)


def discordance_of_independent(first: float, second: float) -> float:
    """Return how often two policies differ if their outcomes are independent.

    Args:
        first: success rate of one.
        second: success rate of the other.
    """
    return first * (1 - second) + second * (1 - first)
