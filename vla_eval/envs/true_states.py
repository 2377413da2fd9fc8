"""Keep what an environment shows apart from what is, where its `evaluate` writes poses.

The true poses are remembered before `evaluate`, and put back before the next physics step, unless it also
writes a velocity: then the object is placed for good. docs/official_suite.md says why.
"""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any  # ManiSkill is untyped: its environments, actors and infos are Any here

import numpy as np
import torch
from mani_skill.utils.structs.actor import Actor

Info = dict[str, Any]
PARKED_ABOVE_M = 500.0  # the official tasks park at 1000 m; nothing on a table comes near


class TrueStates:
    """Comes before the class of an environment with one scene on the CPU: its physics see no shown poses."""

    _evaluated: Info | None = None
    _true_poses: Mapping[int, Any] = {}  # of what is shown elsewhere: id of the body -> sapien.Pose
    _parked_poses: Mapping[int, Any] = {}

    def evaluate(self) -> Info:
        """Evaluate once per control step; asked again, return the same and change nothing."""
        if self._evaluated is None:
            bodies = _movable(self)
            before = {key: body.pose for key, body in bodies.items()}
            with _velocity_writes() as placed:
                self._evaluated = super().evaluate()  # type: ignore[misc]
            self._true_poses = {
                key: before[key]
                for key, body in bodies.items()
                if key not in placed and not _same(before[key], body.pose)
            }
        # Rewards write into what they are given.
        return {
            name: value.clone() if torch.is_tensor(value) else value
            for name, value in self._evaluated.items()
        }

    def put_back(self) -> None:
        """Give every object that `evaluate` only showed elsewhere its true pose."""
        if self._true_poses:
            bodies = _movable(self)
            for key, pose in self._true_poses.items():
                bodies[key].pose = pose
        self._true_poses = {}
        self._evaluated = None

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        """Begin an episode with nothing evaluated."""
        self._true_poses, self._parked_poses = {}, {}
        self._evaluated = None
        return super().reset(*args, **kwargs)  # type: ignore[misc]

    def _step_action(self, action: Any) -> Any:
        self.put_back()
        # What is parked stays where it was parked first.
        parked = {}
        actors: Any = self.scene.actors.values()  # type: ignore[attr-defined]
        for body in (body for one in actors if one.px_body_type == "dynamic" for body in one._bodies):
            key, pose = body.entity.per_scene_id, body.entity.pose
            if pose.p[2] > PARKED_ABOVE_M:
                parked[key] = self._parked_poses.get(key, pose)
                body.entity.pose = parked[key]
                body.linear_velocity = body.angular_velocity = np.zeros(3)
        self._parked_poses = parked
        return super()._step_action(action)  # type: ignore[misc]


def _movable(env: Any) -> dict[int, Any]:
    """Return the bodies that can move, by their ids; a view of several actors has the ids of theirs."""
    return {
        entity.per_scene_id: entity
        for actor in env.scene.actors.values()
        if actor.px_body_type != "static"
        for entity in actor._objs
    }


def _same(one: Any, other: Any) -> bool:
    return np.array_equal(one.p, other.p) and np.array_equal(one.q, other.q)


@contextlib.contextmanager
def _velocity_writes() -> Iterator[set[int]]:
    """Give the ids of the bodies whose linear velocity is written within."""
    placed: set[int] = set()
    original = Actor.set_linear_velocity

    def noting(actor: Any, velocity: Any) -> None:
        placed.update(entity.per_scene_id for entity in actor._objs)
        original(actor, velocity)

    Actor.set_linear_velocity = noting
    try:
        yield placed
    finally:
        Actor.set_linear_velocity = original
