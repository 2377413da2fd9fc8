"""Players of cart and pole, and of the pendulum."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

LINEAR = {
    "VelocityOnlyCartPole": (0.1, 1.0),
    "PositionOnlyCartPole": (0.0, 1.0),
    "NoisyPositionOnlyCartPole": (0.0, 1.0),
}
"""Weights of the two numbers in view."""
STATE_WEIGHTS = (0.1, 0.2, 1.0, 0.5)
"""Of position, velocity, angle and angular velocity."""
MAX_TORQUE, G, CATCH_RAD = 2.0, 10.0, 0.5


class LinearCartPole(Player):
    """Pushes by the sign of a weighted sum of the observation."""

    def act(self, observation: Any, state: Level) -> int:
        """Return 0 for left, 1 for right."""
        return int(np.dot(LINEAR[self.arguments["game"]], observation) > 0)


class CartPole(Player):
    """Pushes by the sign of a weighted sum of the true state."""

    def act(self, observation: Any, state: Level) -> int:
        """Return 0 for left, 1 for right."""
        return int(np.dot(STATE_WEIGHTS, state["state"]) > 0)


class Pendulum(Player):
    """Pumps energy until the pendulum is almost upright, then holds it there by angle and speed."""

    def act(self, observation: Any, state: Level) -> NDArray[np.float32]:
        """Return the torque."""
        theta, speed = (float(number) for number in state["state"])
        theta = (theta + math.pi) % (2 * math.pi) - math.pi
        if abs(theta) < CATCH_RAD:
            torque = -(20.0 * theta + 4.0 * speed)
        else:
            # Mass and length are 1, the moment of inertia 1/3: energy relative to standing upright.
            energy = speed**2 / 6 + G / 2 * (math.cos(theta) - 1)
            torque = -MAX_TORQUE * math.copysign(1.0, energy) * math.copysign(1.0, speed)
        return np.array([np.clip(torque, -MAX_TORQUE, MAX_TORQUE)], np.float32)
