"""Memory Length: bits are shown at the beginning, one of them is asked for at the end.

Rules: bsuite's MemoryChain, https://github.com/google-deepmind/bsuite/blob/effafc0/bsuite/environments/
memory_chain.py (Apache-2.0). The end is `terminated` here; the official package sets both flags.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import GOOD, HIDDEN, SHOWN, Cell, board_picture
from vla_eval.base_tasks.env import BaseTaskEnv, Level


class MemoryLengthEnv(BaseTaskEnv):
    """A bit is named by the last action.

    Observation (n_bits + 2,) float32: share of time left; index of the bit asked for, before the answer; the
    bits as ±1 in the first two observations, else 0. Action: 0 or 1. Reward ±1 for the last one.

    Args:
        n_delay_steps: the answer is action number `n_delay_steps` + 1.
        n_bits: how many bits are shown.
    """

    level_names = ("context", "query")

    def __init__(
        self, *, n_delay_steps: int, n_bits: int, horizon_steps: int, render_mode: str | None = None
    ) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self._n_delay_steps = n_delay_steps
        self._n_bits = n_bits
        low = np.array([0.0, 0.0, *[-1.0] * n_bits], np.float32)
        high = np.array([1.0, n_bits, *[1.0] * n_bits], np.float32)
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gym.spaces.Discrete(2)

    def true_state(self) -> Level:
        """Return `context` (n_bits,), 0 or 1, and `query`, the index of the bit asked for."""
        return {"context": self._context.copy(), "query": np.array(self._query)}

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.float32]:
        if level is not None:
            self._context: NDArray[np.int64] = np.array(level["context"], np.int64).reshape(self._n_bits)
            self._query = int(level["query"])
        else:
            # The generator of the original, so that a seed is its episode.
            seed = int(self.np_random.integers(2**31)) if seed is None else seed
            rng = np.random.RandomState(seed)
            self._context = rng.binomial(1, 0.5, self._n_bits).astype(np.int64)
            self._query = int(rng.randint(self._n_bits))
        self._time = 0
        self._reward = 0.0
        return self._observation()

    def _advance(self, action: Any) -> tuple[NDArray[np.float32], float, bool]:
        observation = self._observation()
        if self._time < self._n_delay_steps:
            self._time += 1
            return observation, 0.0, False
        self._reward = 1.0 if action == self._context[self._query] else -1.0
        return observation, self._reward, True

    def _observation(self) -> NDArray[np.float32]:
        values = np.zeros(self._n_bits + 2, np.float32)
        values[0] = 1 - self._time / self._n_delay_steps
        if self._time == self._n_delay_steps - 1:
            values[1] = self._query
        if self._time == 0:
            values[2:] = 2 * self._context - 1
        return values

    def _is_success(self) -> bool:
        return self._reward > 0

    def _picture(self) -> NDArray[np.uint8]:
        shown = self._time <= 1 and (self._n_steps or 0) <= 1
        bits = [Cell(str(bit) if shown else "?", SHOWN if shown else HIDDEN) for bit in self._context]
        if self._time >= self._n_delay_steps:
            bits[self._query] = Cell("?", GOOD)
        left = self._n_delay_steps + 1 - (self._n_steps or self._time)
        return board_picture([bits], [f"{max(left, 0)} steps to the answer"])
