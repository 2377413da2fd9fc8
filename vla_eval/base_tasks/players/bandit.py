"""A player of the bandit with perfect memory of its own actions and of what they paid."""

from typing import Any

import numpy as np

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player


class Thompson(Player):
    """Pulls the arm that pays most in a draw from the posterior (Thompson 1933), with uniform priors."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forget all arms."""
        super().begin(rng)
        n_arms = int(self.arguments["num_bandits"])
        self._wins, self._losses = np.ones(n_arms), np.ones(n_arms)
        self._arm: int | None = None

    def act(self, observation: Any, state: Level) -> int:
        """Note what the last arm paid, then pull one."""
        if self._arm is not None:
            (self._wins if observation else self._losses)[self._arm] += 1
        self._arm = int(self.rng.beta(self._wins, self._losses).argmax())
        return self._arm
