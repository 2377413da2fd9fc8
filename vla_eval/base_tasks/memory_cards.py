"""Memory Cards: one card is face up, name the place of its mate.

Rules: https://github.com/kevslinger/DTQN/blob/9f8d72b/envs/memory_cards.py (MIT). The original has no time
limit; here it is 10, 15 and 20 steps a pair: DTQN used 50 steps for five pairs.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import GOOD, HIDDEN, SHOWN, Cell, board_picture
from vla_eval.base_tasks.env import BaseTaskEnv, Level

IN_A_ROW = 10  # cards of a frame


class MemoryCardsEnv(BaseTaskEnv):
    """Pairs lie face down; each step one card is shown, and an action names its mate.

    Observation (2 * n_pairs,): 0 face down, 1 … n_pairs face up, n_pairs + 1 removed. Action: a place.
    Reward: 0 for the mate, which removes both, else -1; the card that was named is not shown.

    Args:
        n_pairs: how many pairs.
    """

    level_names = ("cards", "first_card")

    def __init__(self, *, n_pairs: int, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self._n_pairs = n_pairs
        self.observation_space = gym.spaces.MultiDiscrete([n_pairs + 2] * (2 * n_pairs))
        self.action_space = gym.spaces.Discrete(2 * n_pairs)

    def true_state(self) -> Level:
        """Return `cards`, the value at each place; `first_card`, shown at the reset; `removed` places."""
        return {
            "cards": self._cards.copy(),
            "first_card": np.array(self._first),
            "removed": self._removed.copy(),
        }

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.int64]:
        self._removed = np.zeros(2 * self._n_pairs, bool)
        cards = np.repeat(np.arange(1, self._n_pairs + 1), 2)
        self.np_random.shuffle(cards)
        self._cards = cards
        self._shown = self._draw()
        if level is not None:
            self._cards = np.array(level["cards"], np.int64)
            self._shown = int(level["first_card"])
        self._first = self._shown
        return self._observation()

    def _advance(self, action: Any) -> tuple[NDArray[np.int64], float, bool]:
        is_mate = (
            action != self._shown
            and not self._removed[action]
            and self._cards[action] == self._cards[self._shown]
        )
        if is_mate:
            self._removed[[action, self._shown]] = True
        is_done = bool(self._removed.all())
        if not is_done:
            self._shown = self._draw()
        return self._observation(), 0.0 if is_mate else -1.0, is_done

    def _draw(self) -> int:
        """Return a place that is not removed, drawn as the original does, so that a seed is its episode."""
        place = int(self.np_random.integers(2 * self._n_pairs))
        while self._removed[place]:
            place = int(self.np_random.integers(2 * self._n_pairs))
        return place

    def _observation(self) -> NDArray[np.int64]:
        seen = np.where(self._removed, self._n_pairs + 1, 0).astype(np.int64)
        if not self._removed[self._shown]:
            seen[self._shown] = self._cards[self._shown]
        return seen

    def _is_success(self) -> bool:
        return bool(self._removed.all())

    def _picture(self) -> NDArray[np.uint8]:
        seen = self._observation().tolist()
        removed = self._n_pairs + 1
        cells = [
            Cell("", GOOD) if value == removed else Cell(str(value or ""), SHOWN if value else HIDDEN)
            for value in seen
        ]
        rows = [cells[k : k + IN_A_ROW] for k in range(0, len(cells), IN_A_ROW)]
        return board_picture(rows, [f"{seen.count(removed) // 2} of {self._n_pairs} pairs found"])
