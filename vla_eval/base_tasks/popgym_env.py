"""The thirteen families of POPGym behind the API of this room.

The rules run in popgym 1.0.7 (proroklab/popgym at 410d5aa, MIT), untouched. Changed around them: observations
lie in the declared space (no tuples, copies), `info` holds no answer, time limits are `truncated`, and what
mazelib draws from Python's generator leaves no trace in it.
"""

import contextlib
import importlib
import random
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks import popgym_pictures as pictures
from vla_eval.base_tasks.env import BaseTaskEnv, Level

ALMOST = 1e-9  # of a sum of rewards
COUNTED = 0.9  # the return from which CountRecall counts as solved

Inner = Any
"""An environment of popgym, which is untyped."""


class Ending(NamedTuple):
    """How an episode ended."""

    total: float  # the return
    terminated: bool


class Game(NamedTuple):
    """What has to be known of one game.

    Attributes:
        target: `module:Class` in popgym.
        hidden: its hidden state by names.
        picture: draws it; given the environment and the last observation.
        success: whether an episode was won; None: there is no natural rule.
    """

    target: str
    hidden: Callable[[Inner], Level]
    picture: Callable[[Inner, Any], NDArray[np.uint8]]
    success: Callable[[Inner, Ending], bool] | None


def _all_right(inner: Inner, ending: Ending) -> bool:
    return ending.total > 1 - ALMOST


def _terminated(inner: Inner, ending: Ending) -> bool:
    return ending.terminated


def _deck(inner: Inner) -> Level:
    return {"deck": np.array(inner.deck.idx)}


def _decks(inner: Inner) -> Level:
    return {"value_deck": np.array(inner.value_deck.idx), "query_deck": np.array(inner.query_deck.idx)}


def _maze(inner: Inner) -> Level:
    return {
        "grid": np.array(inner.maze.grid),
        "position": np.array(inner.position),
        "explored": np.array(inner.explored),
    }


def _body(inner: Inner) -> Level:
    return {"state": np.array(inner.state, np.float64)}


GAMES = {
    "Autoencode": Game("autoencode:Autoencode", _deck, pictures.cards, _all_right),
    "RepeatFirst": Game("repeat_first:RepeatFirst", _deck, pictures.cards, _all_right),
    "RepeatPrevious": Game("repeat_previous:RepeatPrevious", _deck, pictures.cards, _all_right),
    "HigherLower": Game("higher_lower:HigherLower", _deck, pictures.cards, None),
    "CountRecall": Game(
        "count_recall:CountRecall", _decks, pictures.counts, lambda _, ending: ending.total >= COUNTED
    ),
    "Concentration": Game(
        "concentration:Concentration",
        lambda inner: {"values": np.array(inner.state)},
        pictures.concentration,
        _terminated,
    ),
    "Battleship": Game(
        "battleship:Battleship",
        lambda inner: {"board": np.array(inner.board), "guesses": np.array(inner.guesses)},
        pictures.battleship,
        _terminated,
    ),
    "MineSweeper": Game(
        "minesweeper:MineSweeper",
        lambda inner: {"grid": np.array(inner.hidden_grid), "numbers": np.array(inner.neighbor_grid)},
        pictures.minesweeper,
        lambda inner, _: bool(np.all(inner.hidden_grid != 0)),
    ),
    "MultiarmedBandit": Game(
        "multiarmed_bandit:MultiarmedBandit",
        lambda inner: {"bandits": np.array(inner.bandits)},
        pictures.bandit,
        None,
    ),
    "LabyrinthExplore": Game("labyrinth_explore:LabyrinthExplore", _maze, pictures.maze, _terminated),
    "LabyrinthEscape": Game("labyrinth_escape:LabyrinthEscape", _maze, pictures.maze, _terminated),
    "VelocityOnlyCartPole": Game(
        "velocity_only_cartpole:VelocityOnlyCartPole",
        _body,
        pictures.cartpole,
        lambda _, end: not end.terminated,
    ),
    "PositionOnlyCartPole": Game(
        "position_only_cartpole:PositionOnlyCartPole",
        _body,
        pictures.cartpole,
        lambda _, end: not end.terminated,
    ),
    "NoisyPositionOnlyCartPole": Game(
        "noisy_position_only_cartpole:NoisyPositionOnlyCartPole",
        _body,
        pictures.cartpole,
        lambda _, end: not end.terminated,
    ),
    "PositionOnlyPendulum": Game(
        "position_only_pendulum:PositionOnlyPendulum", _body, pictures.pendulum, None
    ),
    "NoisyPositionOnlyPendulum": Game(
        "noisy_position_only_pendulum:NoisyPositionOnlyPendulum", _body, pictures.pendulum, None
    ),
}
"""Name -> game."""


class PopgymEnv(BaseTaskEnv):
    """One game of POPGym.

    Args:
        game: its name in `GAMES`.
        horizon_steps: when an episode is truncated.
        render_mode: `rgb_array`, or None.
        **level: arguments of popgym's class.
    """

    def __init__(
        self, *, game: str, horizon_steps: int, render_mode: str | None = None, **level: Any
    ) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self._game = GAMES[game]
        self.has_success = self._game.success is not None
        with warnings.catch_warnings():
            # Of the labyrinths: that they can be solved without memory. docs/base_audit.md says it, too.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._inner: Inner = popgym_class(self._game)(**level)
        self.action_space = self._inner.action_space
        self.observation_space = _without_tuples(self._inner.observation_space)
        self._is_number = isinstance(self.observation_space, gym.spaces.Discrete)
        self._total, self._terminated = 0.0, False
        self._seen: Any = None

    def true_state(self) -> Level:
        """Return what is hidden of the game, under the names that its rules have."""
        return self._game.hidden(self._inner)

    def _begin(self, seed: int | None, level: Level | None) -> Any:
        given = int(self.np_random.integers(2**31)) if seed is None else seed
        guard = (
            _global_generators_as_seeded(given) if self._game.hidden is _maze else contextlib.nullcontext()
        )
        with guard:
            observation, _ = self._inner.reset(seed=given)
        self._total, self._terminated = 0.0, False
        return self._observed(observation)

    def _advance(self, action: Any) -> tuple[Any, float, bool]:
        observation, reward, self._terminated, _, _ = self._inner.step(action)
        self._total += reward
        return self._observed(observation), reward, self._terminated

    def _observed(self, observation: Any) -> Any:
        self._seen = observation
        return int(observation) if self._is_number else np.array(observation, self.observation_space.dtype)

    def _is_success(self) -> bool:
        assert self._game.success is not None
        return bool(self._game.success(self._inner, Ending(float(self._total), bool(self._terminated))))

    def _picture(self) -> NDArray[np.uint8]:
        return self._game.picture(self._inner, self._seen)


def popgym_class(game: Game) -> Callable[..., Inner]:
    """Import and return the class of a game."""
    module, _, name = game.target.partition(":")
    made: Callable[..., Inner] = getattr(importlib.import_module(f"popgym.envs.{module}"), name)
    return made


def _without_tuples(space: gym.Space[Any]) -> gym.Space[Any]:
    if isinstance(space, gym.spaces.Tuple):
        return gym.spaces.MultiDiscrete([int(part.n) for part in space.spaces])  # type: ignore[attr-defined]
    if isinstance(space, gym.spaces.MultiDiscrete):
        return gym.spaces.MultiDiscrete(space.nvec.astype(np.int64), dtype=space.dtype)
    return space


@contextlib.contextmanager
def _global_generators_as_seeded(seed: int) -> Iterator[None]:
    """Seed Python's generator for mazelib; give it, and numpy's, back as they were."""
    state, numpy_state = random.getstate(), np.random.get_state()
    random.seed(seed)  # noqa: TID251  for the draws of others
    try:
        yield
    finally:
        random.setstate(state)
        np.random.set_state(numpy_state)
