"""Choices among items that lie on the table: build them, park them, draw their positions.

Knows nothing of what is shown as the cue, nor of which item is right.
"""

from typing import Any

import numpy as np
import sapien
import torch

from vla_eval.errors import TaskArgumentError
from vla_eval.seeding import Stream
from vla_eval.tasks.choice import ChoiceEnv
from vla_eval.tasks.items import Item, build_item
from vla_eval.tasks.layout import Plane, jittered, slot_centres_m

UPRIGHT_WXYZ = (1.0, 0.0, 0.0, 0.0)


class ItemChoiceEnv(ChoiceEnv):
    """N items that lie, in the response phase, at N places in random order."""

    def __init__(self, *args: Any, items: tuple[Item, ...], **kwargs: Any) -> None:
        """Take the items and build the scene."""
        self.items = items
        super().__init__(*args, **kwargs)

    @property
    def n_items(self) -> int:
        """How many items there are to choose among."""
        return len(self.items)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number and how many items there are."""
        return (self.FAMILY, self.n_items)

    def _load_items(self) -> None:
        self.candidates = [
            build_item(self.scene, item, initial_pose=self._parking_pose(item)) for item in self.items
        ]

    def _parking_pose(self, item: Item) -> sapien.Pose:
        return self.parking_pose(item.name, half_height_m=item.shape.rest_height_m)

    def _sample_slots(self, env: int) -> None:
        """Draw where each item lies in the response phase."""
        places = self._places_m(self.episode_generator(env, Stream.LAYOUT))
        order = self.episode_generator(env, Stream.PERMUTATION).permutation(self.n_items)
        self._slots[env, :, :2] = torch.as_tensor(places[order], dtype=torch.float32)
        heights = [item.shape.rest_height_m for item in self.items]
        self._slots[env, :, 2] = torch.tensor(heights)

    def _places_m(self, rng: np.random.Generator) -> Plane:
        """Draw the (N, 2) places of one episode."""
        return jittered(slot_centres_m(self.n_items), rng)

    def _on_episode_start(self, mask: torch.Tensor) -> None:
        super()._on_episode_start(mask)
        self._park_all(mask)

    def _park_all(self, mask: torch.Tensor) -> None:
        if not bool(mask.any()):  # most steps: one check for all items, not one per item
            return
        for item, actor in zip(self.items, self.candidates, strict=True):
            self.move(actor, mask, self._parking_pose(item))

    def _show_in_middle(self, mask: torch.Tensor, shown: torch.Tensor) -> None:
        """Move the items of these indices, (B,), to the centre of the table where the mask holds."""
        if not bool(mask.any()):
            return
        for index, (item, actor) in enumerate(zip(self.items, self.candidates, strict=True)):
            self.move(actor, mask & (shown == index), sapien.Pose(p=[0, 0, item.shape.rest_height_m]))

    def _reveal_all(self, mask: torch.Tensor) -> None:
        self.reveal(mask, torch.tensor(UPRIGHT_WXYZ, device=self.device))


def check_count(name: str, count: Any, most: int, what: str, *, least: int = 2) -> None:
    """Raise `TaskArgumentError` unless a count is a whole number from `least` to `most`."""
    if not isinstance(count, int) or isinstance(count, bool) or not least <= count <= most:
        raise TaskArgumentError(f"{name}={count!r}: expected {least} to {most}, one per {what}.")
