"""MiniGrid-Memory: an object in the first room says to which side to turn at the end of the hallway.

The rules run in minigrid 3.2.0 (Farama-Foundation/Minigrid at 9092872, Apache-2.0), untouched. The mission,
which is the same text in every episode, is left out of observations.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from minigrid.envs.memory import MemoryEnv
from numpy.typing import NDArray

from vla_eval.base_tasks.env import BaseTaskEnv, Level


class MiniGridMemoryEnv(BaseTaskEnv):
    """Walk to the object that lay in the first room.

    Observation: `image` (7, 7, 3) uint8, codes of object, colour and state of the cells in view; `direction`.
    Actions: left, right, forward, pick up, drop, toggle, done. Reward: 1 - 0.9 * steps / horizon at the right
    object, 0 at the wrong one.

    Args:
        size: side of the grid, odd.
        random_length: whether the hallway's length is drawn.
    """

    def __init__(
        self, *, size: int, random_length: bool, horizon_steps: int, render_mode: str | None = None
    ) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self._inner: Any = MemoryEnv(
            size=size, random_length=random_length, max_steps=horizon_steps, render_mode="rgb_array"
        )
        spaces: Any = self._inner.observation_space
        self.observation_space = gym.spaces.Dict({name: spaces[name] for name in ("direction", "image")})
        self.action_space = self._inner.action_space
        self._reward = 0.0

    def true_state(self) -> Level:
        """Return `grid` (size, size, 3) as MiniGrid encodes it, the agent's pose, and the two ends."""
        inner = self._inner
        return {
            "grid": inner.grid.encode(),
            "position": np.array(inner.agent_pos),
            "direction": np.array(inner.agent_dir),
            "success": np.array(inner.success_pos),
            "failure": np.array(inner.failure_pos),
        }

    def _begin(self, seed: int | None, level: Level | None) -> dict[str, Any]:
        given = int(self.np_random.integers(2**31)) if seed is None else seed
        observation, _ = self._inner.reset(seed=given)
        self._reward = 0.0
        return self._observed(observation)

    def _advance(self, action: Any) -> tuple[dict[str, Any], float, bool]:
        observation, reward, terminated, _, _ = self._inner.step(action)
        self._reward = float(reward)
        return self._observed(observation), self._reward, bool(terminated)

    def _observed(self, observation: dict[str, Any]) -> dict[str, Any]:
        return {"direction": int(observation["direction"]), "image": np.array(observation["image"])}

    def _is_success(self) -> bool:
        return self._reward > 0

    def _picture(self) -> NDArray[np.uint8]:
        return np.asarray(self._inner.get_frame(highlight=True, tile_size=16), np.uint8)

    def close(self) -> None:
        """Close MiniGrid's window."""
        self._inner.close()
