"""Players of Concentration, Battleship and MineSweeper."""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

Tile = tuple[int, int]

N_VALUES = {"colors": 2, "ranks": 13}
MINES = {"easy": (4, 2), "medium": (6, 6), "hard": (8, 10)}
"""Difficulty -> width of the board, mines."""


class AnyHiddenCard(Player):
    """Turns any card that is face down: a view of the table does not say which were seen before."""

    def act(self, observation: Any, state: Level) -> int:
        """Return its place."""
        hidden = np.flatnonzero(observation == N_VALUES[self.arguments["deck_type"]])
        return int(self.rng.choice(hidden)) if len(hidden) else 0


class AnyTile(Player):
    """Chooses any tile: nothing in view says which were chosen before."""

    def act(self, observation: Any, state: Level) -> NDArray[np.int64]:
        """Return row and column."""
        size = _board_size(self.arguments)
        return self.rng.integers(size, size=2)


class Concentration(Player):
    """Remembers every face; pairs what is known, else turns what it has not seen."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forget the faces."""
        super().begin(rng)
        self._known: dict[int, int] = {}
        self._matched: set[int] = set()
        self._turn: list[int] = []

    def act(self, observation: Any, state: Level) -> int:
        """Return the place of the card to turn."""
        face_down = N_VALUES[self.arguments["deck_type"]]
        self._known |= {int(p): int(observation[p]) for p in np.flatnonzero(observation != face_down)}
        if len(self._turn) == 2:
            first, second = self._turn
            if self._known[first] == self._known[second]:
                self._matched |= {first, second}
            self._turn = []
        place = self._first() if not self._turn else self._second(len(observation))
        self._turn.append(place)
        self._n_cards = len(observation)
        return place

    def _open(self) -> dict[int, int]:
        return {place: value for place, value in self._known.items() if place not in self._matched}

    def _first(self) -> int:
        places: dict[int, int] = {}
        for place, value in self._open().items():
            if value in places:
                return places[value]
            places[value] = place
        unseen = [place for place in range(self._size()) if place not in self._known]
        return int(self.rng.choice(unseen)) if unseen else next(iter(places.values()))

    def _second(self, n_cards: int) -> int:
        first = self._turn[0]
        same = [p for p, v in self._open().items() if v == self._known[first] and p != first]
        if same:
            return same[0]
        unseen = [place for place in range(n_cards) if place not in self._known]
        return int(self.rng.choice(unseen)) if unseen else first

    def _size(self) -> int:
        return 52 * int(self.arguments["num_decks"])


class Battleship(Player):
    """Remembers its shots; after a hit it tries the tiles around it, else any that it has not tried."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forget the shots."""
        super().begin(rng)
        self._tried: dict[Tile, bool] = {}
        self._last: Tile | None = None

    def act(self, observation: Any, state: Level) -> NDArray[np.int64]:
        """Return row and column."""
        if self._last is not None:
            self._tried[self._last] = bool(observation)
        size = _board_size(self.arguments)
        open_tiles = [tile for tile in _tiles(size) if tile not in self._tried]
        hits = {tile for tile, was_hit in self._tried.items() if was_hit}
        scores = [_in_line(tile, hits) for tile in open_tiles]
        best = [tile for tile, score in zip(open_tiles, scores, strict=True) if score == max(scores)]
        self._last = best[int(self.rng.integers(len(best)))]
        return np.array(self._last)


def _in_line(tile: Tile, hits: set[Tile]) -> int:
    """Return 2 next to two hits in a line, 1 next to one, 0 elsewhere."""
    best = 0
    for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        if (tile[0] + di, tile[1] + dj) in hits:
            best = max(best, 2 if (tile[0] + 2 * di, tile[1] + 2 * dj) in hits else 1)
    return best


class MineSweeper(Player):
    """Remembers tiles and numbers; takes a tile that is safe by one number, else the least likely mine."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forget the board."""
        super().begin(rng)
        self._numbers: dict[Tile, int] = {}
        self._last: Tile | None = None

    def act(self, observation: Any, state: Level) -> NDArray[np.int64]:
        """Return row and column."""
        if self._last is not None:
            self._numbers[self._last] = int(observation)
        size, n_mines = MINES[self.arguments["difficulty"]]
        unknown = [tile for tile in _tiles(size) if tile not in self._numbers]
        risk = self._risks(unknown, n_mines / len(unknown))
        lowest = min(risk.values())
        best = [tile for tile in unknown if risk[tile] == lowest]
        self._last = best[int(self.rng.integers(len(best)))]
        return np.array(self._last)

    def _risks(self, unknown: list[Tile], otherwise: float) -> dict[Tile, float]:
        """Return the chance of a mine as single numbers say it; known mines are 1."""
        open_tiles, mines = set(unknown), set[Tile]()
        risk = dict.fromkeys(unknown, otherwise)
        for _ in range(len(unknown)):
            n_known = len(mines)
            risk = dict.fromkeys(unknown, otherwise)
            safe: set[Tile] = set()
            for tile, number in self._numbers.items():
                around = [near for near in _around(tile) if near in open_tiles]
                left = number - sum(near in mines for near in around)
                free = [near for near in around if near not in mines]
                if free and left == len(free):
                    mines |= set(free)
                elif left == 0:
                    safe |= set(free)
                elif free:
                    for near in free:
                        risk[near] = max(risk[near], left / len(free))
            risk |= dict.fromkeys(mines, 1.0) | dict.fromkeys(safe - mines, 0.0)
            if len(mines) == n_known:
                break
        return risk


def _tiles(size: int) -> list[Tile]:
    return [(row, column) for row in range(size) for column in range(size)]


def _around(tile: Tile) -> list[Tile]:
    return [(tile[0] + di, tile[1] + dj) for di, dj in product((-1, 0, 1), repeat=2) if (di, dj) != (0, 0)]


def _board_size(arguments: Any) -> int:
    if "difficulty" in arguments:
        return MINES[arguments["difficulty"]][0]
    return int(arguments["board_size"])
