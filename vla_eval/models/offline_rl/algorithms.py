"""Names of the algorithms, and what has to be known of them. Without torch."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmRow:
    """What has to be known of an algorithm before its network is made.

    Attributes:
        reads_rewards: it is more than imitation.
        draws_actions: the actor is a distribution, whose mean acts.
        has_value: there is a network of values beside those of action values.
        has_targets: networks of action values follow slowly, for the right side of Bellman's equation.
    """

    reads_rewards: bool = True
    draws_actions: bool = False
    has_value: bool = False
    has_targets: bool = True


ALGORITHMS = {
    "cql": AlgorithmRow(draws_actions=True),
    "cql_published": AlgorithmRow(reads_rewards=False, has_targets=False),
    "iql": AlgorithmRow(has_value=True),
}
