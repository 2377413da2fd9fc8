"""Everyday things that stand around and are no part of a task, fixed to the table.

They change what is seen, and stop an arm that hits them. (Measured: things that can be moved change how
others settle, by up to 4e-5.)
"""

from collections.abc import Callable, Iterator
from typing import Any  # ManiSkill is untyped: its scenes and actors are Any here

import numpy as np
import sapien

from vla_eval.core import FloatArray
from vla_eval.tasks.objects.bodies import Flags
from vla_eval.tasks.objects.free_places import drawn_poses
from vla_eval.tasks.objects.items import Item, build_fixed
from vla_eval.tasks.objects.layout import Plane
from vla_eval.tasks.objects.things import THINGS


class Clutter:
    """The bodies of some things in one scene; without names there is none."""

    def __init__(
        self, scene: Any, names: tuple[str, ...], places_m: Plane, *, parked: Callable[..., sapien.Pose]
    ) -> None:
        """Build them at `parked(name, half_height_m=…)`; `places_m` (S, 2) are where they can stand."""
        self._places_m = places_m
        self._rest_height_m = [THINGS[name].rest_height_m for name in names]
        self._actors = [
            build_fixed(scene, Item(THINGS[name]), initial_pose=parked(name, half_height_m=height_m))
            for name, height_m in zip(names, self._rest_height_m, strict=True)
        ]

    def drawn(
        self, mask: Flags, generator_of: Callable[[int], np.random.Generator]
    ) -> Iterator[tuple[Any, FloatArray]]:
        """Yield each actor with its (B, 7) positions and rotations (wxyz), world frame, where (B,) holds.

        `generator_of(env)` is the generator of the episode in a parallel environment.
        """
        poses = np.zeros((len(mask), len(self._actors), 7), dtype=np.float32)
        for env in np.flatnonzero(mask).tolist() if self._actors else ():
            x_m, y_m, yaw_rad = drawn_poses(self._places_m, generator_of(env))[: len(self._actors)].T
            poses[env, :, 0], poses[env, :, 1], poses[env, :, 2] = x_m, y_m, self._rest_height_m
            poses[env, :, 3], poses[env, :, 6] = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
        for index, actor in enumerate(self._actors):
            yield actor, poses[:, index]
