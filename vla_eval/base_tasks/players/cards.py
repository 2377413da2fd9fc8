"""Players of the card games. Those with perfect memory remember observations; none reads the hidden deck."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

CARDS, N_SUITS, N_RANKS = 52, 4, 13
MIDDLE_RANK = 6
KINDS = {"colors": 2, "suits": 4, "ranks": 13}


class Constant(Player):
    """Says 0: no answer is better where the current observation says nothing."""

    def act(self, observation: Any, state: Level) -> int:
        """Return 0."""
        return 0


class AnotherSuit(Player):
    """Names a suit that is not in view: 13 of the other 51 cards have it, 12 have the one in view."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the next suit."""
        return int((observation + 1) % N_SUITS)


class SuitShown(Player):
    """Names the suit in view: right once, when the last card is shown and already asked for."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the suit."""
        return int(observation[1])


class LikelyCount(Player):
    """Names the count that is right most often; knows whether value and query agree, not the step."""

    def __init__(self, arguments: dict[str, Any]) -> None:
        super().__init__(arguments)
        n_cards = CARDS * int(arguments["num_decks"])
        n_alike = n_cards // KINDS[arguments["deck_type"]]
        self._counts = {is_same: _likely_count(n_cards, n_alike, is_same) for is_same in (True, False)}

    def act(self, observation: Any, state: Level) -> int:
        """Return the count."""
        return self._counts[bool(observation[0] == observation[1])]


class HigherThanSeven(Player):
    """Bets on higher below the middle rank, on lower above it."""

    def act(self, observation: Any, state: Level) -> int:
        """Return 0 for higher, 1 for lower."""
        return int(observation > MIDDLE_RANK)


class _Remembering(Player):
    """Keeps all observations."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forget them."""
        super().begin(rng)
        self.seen: list[Any] = []

    def act(self, observation: Any, state: Level) -> int:
        """Remember, then answer."""
        self.seen.append(observation)
        return self.answer(self.seen)

    def answer(self, seen: Sequence[Any]) -> int:
        """Return the action by all observations so far."""
        raise NotImplementedError


class RepeatFirst(_Remembering):
    """Names the first suit."""

    def answer(self, seen: Sequence[Any]) -> int:
        """Return it."""
        return int(seen[0])


class RepeatPrevious(_Remembering):
    """Names the suit of k observations ago."""

    def answer(self, seen: Sequence[Any]) -> int:
        """Return it; before there are so many, any."""
        k = int(self.arguments["k"])
        return int(seen[-k]) if len(seen) >= k else 0


class Autoencode(_Remembering):
    """Names the suits in reverse."""

    def answer(self, seen: Sequence[Any]) -> int:
        """Return the suit that is due."""
        n_cards = CARDS * int(self.arguments["num_decks"])
        n_answered = len(seen) - n_cards
        return int(seen[n_cards - 1 - n_answered][1]) if n_answered >= 0 else 0


class CountRecall(_Remembering):
    """Counts the values."""

    def answer(self, seen: Sequence[Any]) -> int:
        """Return how often the query occurred among them."""
        query = int(seen[-1][1])
        return sum(int(value) == query for value, _ in seen)


class HigherLower(_Remembering):
    """Counts the cards that are gone."""

    def answer(self, seen: Sequence[Any]) -> int:
        """Bet on what more of the cards left are."""
        gone, now = Counter(map(int, seen)), int(seen[-1])
        n_each = N_SUITS * int(self.arguments["num_decks"])
        left = [n_each - gone[rank] for rank in range(N_RANKS)]
        return int(sum(left[now + 1 :]) < sum(left[:now]))


def _likely_count(n_cards: int, n_alike: int, is_same: bool) -> int:
    """Return the most likely number of cards of one kind among those dealt, over all steps that are answered.

    Args:
        n_cards: cards in the deck.
        n_alike: cards of each kind.
        is_same: whether the card just dealt is of that kind.
    """
    chances: Counter[int] = Counter()
    n_of_kind, n_others = (n_alike - 1, n_cards - n_alike) if is_same else (n_alike, n_cards - n_alike - 1)
    for n_before in range(n_cards - 1):  # cards dealt before the one in view
        ways = math.comb(n_cards - 1, n_before)
        for count in range(min(n_before, n_of_kind) + 1):
            chance = math.comb(n_of_kind, count) * math.comb(n_others, n_before - count) / ways
            chances[count + is_same] += chance  # type: ignore[assignment]
    return max(chances, key=chances.__getitem__)
