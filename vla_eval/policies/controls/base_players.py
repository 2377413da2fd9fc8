"""Controls of MIKASA-Base: random actions, the best player without memory, the one with all of it."""

import zlib
from collections.abc import Sequence

import numpy as np

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.named import as_native, spaces_of
from vla_eval.base_tasks.players.play import Kind, player_of
from vla_eval.base_tasks.players.player import Player
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import SpecMismatchError
from vla_eval.policies.context import PolicyContext
from vla_eval.seeding import Stream, generator
from vla_eval.specs import PolicySpec
from vla_eval.task_state import HiddenState
from vla_eval.tasks.catalog import task_spec


class PlayerPolicy:
    """A scripted player, one object per slot."""

    def __init__(self, context: PolicyContext, kind: Kind) -> None:
        self._kind, self._env = kind, context.env
        self._observed, self._acts = spaces_of(context.env.task)
        self._players: dict[int, Player] = {}
        self._make_player()  # refuses a task without one
        self.spec = PolicySpec(
            name=context.name,
            reads="every",
            cameras=() if kind == "random" else tuple(camera.name for camera in context.env.cameras),
            states=() if kind == "random" else tuple(state.name for state in context.env.states),
            chunk_size=context.chunking.planned_rows,
            privileged=kind == "oracle",
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Seed each episode's player by its task, seed and run."""
        for episode in episodes:
            if episode.slot not in self._players:
                self._players[episode.slot] = self._make_player()
            task_key = zlib.crc32(episode.task.encode())
            self._players[episode.slot].begin(generator(episode.seed, Stream.POLICY, task_key, episode.run))

    def forget(self, slots: Sequence[int]) -> None:
        """Release the players of these slots."""
        for slot in slots:
            self._players.pop(slot, None)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the player's action."""
        seen = None if self._kind == "random" else as_native(self._observed, window.last)
        action = self._players[window.slot].act(seen, self._state(window))
        return ActionChunk(actions=np.asarray(action, np.float32).reshape(1, -1))

    def _make_player(self) -> Player:
        return player_of(self._env.task, self._kind, self._acts)

    def _state(self, window: ObservationWindow) -> Level:
        if self._kind != "oracle":
            return {}
        hidden = window.last.privileged
        if not isinstance(hidden, HiddenState):
            raise SpecMismatchError(
                f"policy '{self.spec.name}' reads what is hidden in {self._env.task}, but its observations "
                "do not carry it. Make the environment with privileged=True."
            )
        return hidden.values


def make_memoryless(context: PolicyContext) -> PlayerPolicy:
    """Make the `memoryless` control; raises `SpecMismatchError` where none is known."""
    if not task_spec(context.env.task).is_base:
        raise SpecMismatchError(
            f"policy '{context.name}' acts in MIKASA-Base, and {context.env.task} is a robot's task."
        )
    return PlayerPolicy(context, "memoryless")
