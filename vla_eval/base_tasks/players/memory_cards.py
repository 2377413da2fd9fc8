"""Players of Memory Cards."""

from typing import Any

import numpy as np

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player


class AnyHiddenPlace(Player):
    """Names any place that is face down."""

    def act(self, observation: Any, state: Level) -> int:
        """Return it."""
        return int(self.rng.choice(np.flatnonzero(observation == 0)))


class PerfectRecall(Player):
    """Remembers each face that it saw, and which pairs of places are not mates."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forget them."""
        super().begin(rng)
        self._faces: dict[int, int] = {}
        self._not_mates: set[frozenset[int]] = set()
        self._tried: tuple[int, int] | None = None

    def act(self, observation: Any, state: Level) -> int:
        """Name the mate of the card that is face up, if it was seen, else any place that can be it."""
        removed = int(self.arguments["n_pairs"]) + 1
        if self._tried is not None and observation[self._tried[0]] != removed:
            self._not_mates.add(frozenset(self._tried))
        shown = int(np.flatnonzero((observation > 0) & (observation < removed))[0])
        value = int(observation[shown])
        self._faces[shown] = value
        same = [place for place, face in self._faces.items() if face == value and place != shown]
        open_places = [
            int(place)
            for place in np.flatnonzero(observation == 0)
            if int(place) not in self._faces and frozenset((shown, int(place))) not in self._not_mates
        ]
        mate = same[0] if same else int(self.rng.choice(open_places))
        self._tried = (shown, mate)
        return mate
