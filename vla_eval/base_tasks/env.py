"""What all MIKASA-Base environments share: seeds, levels, the horizon, success, checks of what is given.

An episode is a function of seed, level and actions; nothing is drawn from global state.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any  # observations, actions and infos, as Gymnasium has them

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from vla_eval.errors import InvalidActionError, TaskArgumentError, check_names

RGB_ARRAY = "rgb_array"
LEVEL = "level"

Level = Mapping[str, NDArray[Any]]
"""What is hidden of an episode: name -> array."""


class BaseTaskEnv(gym.Env[Any, Any], ABC):
    """One MIKASA-Base environment.

    `terminated`: the rules end the episode; `truncated`: the horizon does; never both. The last step's info
    has `success`, if there is a natural rule; no info has the answer. `reset(options={"level": …})` begins a
    given level (`true_state()` right after a reset has its arrays) in place of one that the seed draws.

    Attributes:
        horizon_steps: the episode is truncated after so many steps.
        has_success: whether there is a natural success rule.
        level_names: the arrays of a level that can be given.
    """

    metadata = {"render_modes": [RGB_ARRAY], "render_fps": 10}  # noqa: RUF012  gymnasium declares it so
    has_success = True
    level_names: tuple[str, ...] = ()

    def __init__(self, *, horizon_steps: int, render_mode: str | None = None) -> None:
        if render_mode not in (None, RGB_ARRAY):
            raise TaskArgumentError(f"render_mode={render_mode!r}: expected '{RGB_ARRAY}' or None.")
        self.horizon_steps = horizon_steps
        self.render_mode = render_mode
        self._n_steps: int | None = None  # None: no episode is under way
        self._spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's description, with the horizon.

        The id is registered without one: Gymnasium's `TimeLimit` would set `truncated` also where the rules
        end the episode at the same step.
        """
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._spec = value and replace(value, max_episode_steps=self.horizon_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin the episode of a seed; without one, the next of the generator seeded last.

        Args:
            seed: 0 or more.
            options: `{"level": {name: array}}` gives the hidden level.

        Raises:
            TaskArgumentError: there is no such option, or the level is not one of this environment.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        level = given.pop(LEVEL, None)
        check_names("option", given, (LEVEL,), where="reset")
        if level is not None:
            self._check_level(level)
        self._n_steps = 0
        return self._begin(seed, level), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Execute one step.

        Raises:
            InvalidActionError: the action is not one of the action space.
        """
        if self._n_steps is None:
            raise gym.error.ResetNeeded(f"{type(self).__name__}: call reset() before step().")
        observation, reward, terminated = self._advance(self._checked(action))
        self._n_steps += 1
        truncated = not terminated and self._n_steps >= self.horizon_steps
        info: dict[str, Any] = {}
        if terminated or truncated:
            self._n_steps = None
            if self.has_success:
                info["success"] = self._is_success()
        return observation, float(reward), bool(terminated), truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return what a person would see, (H, W, 3) RGB; None without a render mode."""
        return self._picture() if self.render_mode == RGB_ARRAY else None

    @abstractmethod
    def true_state(self) -> Level:
        """Return what is hidden, for scripted controls: the level, and what changes of it by the step."""

    @abstractmethod
    def _begin(self, seed: int | None, level: Level | None) -> Any:
        """Begin an episode and return its first observation; `self.np_random` has been seeded."""

    @abstractmethod
    def _advance(self, action: Any) -> tuple[Any, float, bool]:
        """Return observation, reward, and whether the rules end the episode."""

    def _is_success(self) -> bool:
        """Whether the episode that has just ended is a success."""
        raise NotImplementedError

    @abstractmethod
    def _picture(self) -> NDArray[np.uint8]:
        """Draw the current step."""

    def _check_level(self, level: object) -> None:
        if not isinstance(level, Mapping) or set(level) != set(self.level_names):
            found = sorted(map(str, level)) if isinstance(level, Mapping) else f"{level!r:.80}"
            names = ", ".join(self.level_names)
            expected = f"a level with {names}" if names else "no level: they come from seeds alone"
            raise TaskArgumentError(
                f"{type(self).__name__}: reset(options): expected {expected}; found {found}."
            )

    def _checked(self, action: Any) -> Any:
        """Return the action as the space's own type; a whole number may come as any integer type."""
        space = self.action_space
        if isinstance(space, gym.spaces.Discrete):
            # The usual cases first: to ask the space takes longer than a step of a small game.
            number = action.item() if isinstance(action, np.ndarray) and action.size == 1 else action
            if isinstance(number, int | np.integer) and 0 <= number - space.start < space.n:
                return int(number)
        else:
            values = np.asarray(action)
            if isinstance(space, gym.spaces.MultiDiscrete):
                counts = space.nvec.tolist()
                is_one = values.dtype.kind in "iu" and values.shape == space.shape
                if is_one and all(0 <= number < n for number, n in zip(values.tolist(), counts, strict=True)):
                    return values.astype(space.dtype)
            elif values.dtype.kind in "iuf" and space.contains(values.astype(space.dtype)):
                return values.astype(space.dtype)
        raise InvalidActionError(
            f"{type(self).__name__}: expected an action of {space}, found {action!r:.200}."
        )
