"""Players of MiniGrid-Memory."""

from typing import Any

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

TURN_LEFT, TURN_RIGHT, FORWARD = range(3)
EAST, SOUTH, WEST, NORTH = range(4)
AHEAD = (3, 5)  # the cell before the agent in its view
WALL = 2


class Oracle(Player):
    """Walks to the junction and turns to the right object, whose side it knows."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the action."""
        (x, y), facing = (int(number) for number in state["position"]), int(state["direction"])
        goal_x, goal_y = (int(number) for number in state["success"])
        if x < goal_x:
            return FORWARD  # it begins in the hallway and faces east
        if facing == EAST:
            return TURN_LEFT if goal_y < y else TURN_RIGHT
        return FORWARD


class TurnsLeft(Player):
    """Walks to the junction and always turns left, by what is before it and the compass."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the action."""
        is_wall = observation["image"][AHEAD][0] == WALL
        return TURN_LEFT if observation["direction"] == EAST and is_wall else FORWARD
