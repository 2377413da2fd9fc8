"""Choices among items that lie on the table: build them, park them, draw their positions.

Knows nothing of what is shown as the cue, nor of which item is right.
"""

from collections.abc import Collection
from typing import Any

import numpy as np
import sapien

from vla_eval.seeding import Stream
from vla_eval.tasks.choice import ChoiceEnv
from vla_eval.tasks.memory_env import CueSize, Place
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import Flags, Indices, Steps, anywhere
from vla_eval.tasks.objects.free_places import Area, free_things, used_areas
from vla_eval.tasks.objects.items import Item, build_decoy, build_item
from vla_eval.tasks.objects.layout import Plane, jittered, slot_centres_m
from vla_eval.tasks.objects.limits import StepCount

WIDEST_HALF_M = 0.03
UPRIGHT_WXYZ = (1.0, 0.0, 0.0, 0.0)


class ItemChoiceEnv(ChoiceEnv):
    """N items that lie, in the response phase, at N places in random order.

    If the cue is swapped, decoys show it: kinematic copies of the items without collision shapes. The items
    themselves are moved as for the drawn cue, but are invisible until the response phase. So the physics is
    that of the cue as drawn, to the last bit: an item that has been shown settles in another way when it
    appears again (measured: by up to 0.3 µm and 7e-6). On the GPU simulator, whose results are not
    reproducible to the last bit, the items themselves are swapped.

    Args:
        items: what there is to choose among.
        distract_steps: for so many steps in the middle of the delay, a decoy of another item is seen where
            single items are shown; it is drawn per episode, and it is neither right nor was it shown.
    """

    def __init__(
        self, *args: Any, items: tuple[Item, ...], distract_steps: StepCount = 0, **kwargs: Any
    ) -> None:
        limits.check(StepCount, distract_steps=distract_steps)
        self.items = items
        self.distract_steps = distract_steps
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
        self._hides_items = self.is_swapped() and not self.gpu_sim_enabled
        uses_decoys = self._hides_items or self.distract_steps > 0
        self.decoys = [
            build_decoy(self.scene, item, initial_pose=self._parking_pose(item, "_decoy"))
            for item in (self.items if uses_decoys else ())
        ]
        self._distractor: Indices = np.zeros(self.num_envs, dtype=np.int64)

    def is_swapped(self) -> bool:
        """Return whether another cue than the drawn one is shown."""
        return self.swap_cue > 0

    def _parking_pose(self, item: Item, suffix: str = "") -> sapien.Pose:
        return self.parking_pose(f"{item.name}{suffix}", half_height_m=item.shape.rest_height_m)

    def _sample_slots(self, env: int) -> None:
        places = self._places_m(self.episode_generator(env, Stream.LAYOUT))
        order = self.episode_generator(env, Stream.PERMUTATION).permutation(self.n_items)
        self._slots[env, :, :2] = places[order]
        self._slots[env, :, 2] = [item.shape.rest_height_m for item in self.items]

    def _places_m(self, rng: np.random.Generator) -> Plane:
        """Draw the (N, 2) places of one episode."""
        return jittered(slot_centres_m(self.n_items), rng)

    def _on_episode_start(self, mask: Flags) -> None:
        super()._on_episode_start(mask)
        self._park_all(mask)
        self._set_visible(mask, False)

    def _park_all(self, mask: Flags) -> None:
        if not anywhere(mask):  # most steps: one check for all items, not one per item
            return
        for item, actor in zip(self.items, self.candidates, strict=True):
            self.move(actor, mask, self._parking_pose(item))
        self._park_decoys(mask)

    def _park_decoys(self, mask: Flags) -> None:
        for item, decoy in zip(self.items, self.decoys, strict=False):  # of no decoys or of all
            self.move(decoy, mask, self._parking_pose(item, "_decoy"))

    def _sample_distractor(self, env: int, excluded: Collection[int]) -> None:
        """Draw the item that distracts, after the cue: none that is right, or that the drawn cue shows."""
        if self.distract_steps:
            others = [index for index in range(self.n_items) if index not in excluded]
            drawn = self.episode_generator(env, Stream.DISTRACTOR).integers(len(others))
            self._distractor[env] = others[int(drawn)]

    def _distract(self, step: Steps, mask: Flags) -> Flags:
        """Show the distractor, or remove it, where its time begins or ends at `step`; return (B,) where."""
        if not self.distract_steps:
            return np.zeros_like(mask)
        delay = self._response_step - self._cue_end_step
        first = self._cue_end_step + (delay - self.distract_steps) // 2
        begins, ends = mask & (step == first), mask & (step == first + self.distract_steps)
        self._park_decoys(ends)
        for index, item in enumerate(self.items):
            middle = sapien.Pose(p=[0, 0, item.shape.rest_height_m])
            self.move(self.decoys[index], begins & (self._distractor == index), middle)
        either: Flags = begins | ends
        return either

    def _show_in_middle(self, mask: Flags, drawn: Indices, shown: Indices) -> None:
        """Move items (B,) to the table's centre where (B,) holds; `shown` are seen if the cue is swapped."""
        if not anywhere(mask):
            return
        for index, item in enumerate(self.items):
            middle = sapien.Pose(p=[0, 0, item.shape.rest_height_m])
            self._show_item(index, middle, moved=mask & (drawn == index), seen=mask & (shown == index))

    def _show_item(self, index: int, pose: sapien.Pose, *, moved: Flags, seen: Flags) -> None:
        """Move an item where `moved` (B,) holds, so that it is seen where `seen` (B,) holds."""
        self.move(self.candidates[index], moved if self._hides_items else seen, pose)
        if self._hides_items:
            self.move(self.decoys[index], seen, pose)

    def used_areas(self) -> tuple[Area, ...]:
        """Return where items can lie and be shown, with the hand over them."""
        return used_areas(n_items=self.n_items, goal_threshold_m=self.goal_threshold_m)

    def free_things(self) -> tuple[str, ...]:
        """Return the names of the everyday things that are none of the items."""
        return free_things({item.name for item in self.items})

    def cue_places_m(self, env: int) -> list[Place]:
        """Return where items are shown as the cue, on the table, world frame."""
        return [(0.0, 0.0, 0.0)]

    def cue_size_m(self) -> CueSize:
        """Return a size that no item exceeds: a cross is 6 cm wide."""
        highest = max(item.shape.rest_height_m for item in self.items)
        return CueSize(half_width_m=max(WIDEST_HALF_M, highest), height_m=2 * highest)

    def _set_visible(self, mask: Flags, visible: bool) -> None:
        """Let the items be seen or not, if decoys show the cue: on the CPU simulator alone."""
        if not self._hides_items or not mask.any():
            return
        for actor in self.candidates:
            for entity in actor._objs:
                body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
                if body is not None:  # without a renderer there is none
                    body.visibility = float(visible)

    def _reveal_all(self, mask: Flags) -> None:
        self._set_visible(mask, True)
        self.reveal(mask, UPRIGHT_WXYZ)
