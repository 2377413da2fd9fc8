"""Bodies as arrays: torch and SAPIEN end here, numpy begins. And their state for privileged readers.

On the CPU simulator a body is read from SAPIEN itself, which takes a tenth of the time that ManiSkill's
tensors take; on the GPU simulator ManiSkill's tensors are copied.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple  # ManiSkill is untyped: its actors and links are Any here

import numpy as np
import torch
from mani_skill.utils.structs import Link
from numpy.typing import NDArray

from vla_eval.core import FloatArray
from vla_eval.task_state import BodyState

Flags = NDArray[np.bool_]
"""(B,) or (B, N): where something holds."""
Steps = NDArray[np.int32]
"""(B,) control steps."""
Indices = NDArray[np.int64]
"""(B,) or (B, N): indices of candidates, or counts of them."""


class Body(NamedTuple):
    """Position (B, 3) in m, linear velocity (B, 3) in m/s and yaw (B,) in rad, world frame."""

    position_m: FloatArray
    velocity_m_s: FloatArray
    yaw_rad: FloatArray

    def state(self, env: int) -> BodyState:
        """Return it in one parallel environment, as new numbers."""
        return BodyState(
            position_m=self.position_m[env].astype(np.float64),
            velocity_m_s=self.velocity_m_s[env].astype(np.float64),
            yaw_rad=float(self.yaw_rad[env]),
        )


def to_array(tensor: Any) -> FloatArray:
    """Return a tensor as new float32 numbers."""
    copied: FloatArray = tensor.detach().cpu().numpy().astype(np.float32, copy=True)
    return copied


def _on_gpu(body: Any) -> bool:
    return bool(body.scene.gpu_sim_enabled)


def _sapien_pose(body: Any) -> Any:
    one = body._objs[0]
    return one.entity_pose if isinstance(body, Link) else one.pose


def pose_of(body: Any) -> FloatArray:
    """Return (B, 7): position and rotation (wxyz) of an actor or a link, world frame."""
    if _on_gpu(body):
        return to_array(body.pose.raw_pose)
    pose = _sapien_pose(body)
    both: FloatArray = np.concatenate((pose.p, pose.q))[None]
    return both


def position_of(body: Any) -> FloatArray:
    """Return (B, 3): the position of an actor or a link, world frame."""
    if _on_gpu(body):
        return to_array(body.pose.p)
    position: FloatArray = _sapien_pose(body).p[None]
    return position


def positions_of(bodies: Sequence[Any]) -> FloatArray:
    """Return (B, N, 3): the positions of actors, world frame."""
    if _on_gpu(bodies[0]):
        return np.stack([to_array(body.pose.p) for body in bodies], axis=1)
    return np.array([body._objs[0].pose.p for body in bodies])[None]


def position_of_one(bodies: Sequence[Any], index: Indices) -> FloatArray:
    """Return (B, 3): the position of the actor that has this (B,) index, world frame."""
    if _on_gpu(bodies[0]):
        positions: FloatArray = positions_of(bodies)[np.arange(len(index)), index]
        return positions
    return position_of(bodies[index[0]])


def velocity_of(body: Any) -> FloatArray:
    """Return (B, 3): the linear velocity of an actor or a link, world frame; 0 for a kinematic actor."""
    if _on_gpu(body):
        return to_array(body.linear_velocity)
    velocity: FloatArray = body._bodies[0].linear_velocity[None]
    return velocity


def spin_of(body: Any) -> FloatArray:
    """Return (B, 3): the angular velocity of an actor or a link, world frame."""
    if _on_gpu(body):
        return to_array(body.angular_velocity)
    spin: FloatArray = body._bodies[0].angular_velocity[None]
    return spin


def place(actor: Any, pose: Any) -> None:
    """Move an actor of a scene on the CPU, at rest, to a `sapien.Pose`."""
    actor._objs[0].pose = pose
    if actor.px_body_type == "dynamic":
        body = actor._bodies[0]
        body.linear_velocity = body.angular_velocity = np.zeros(3, dtype=np.float32)


def length(vectors: FloatArray) -> FloatArray:
    """Return the Euclidean length of the last dimension."""
    norm: FloatArray = np.sqrt(np.add.reduce(vectors * vectors, axis=-1))
    return norm


def anywhere(flags: Flags) -> bool:
    """Return whether a flag holds; `any` takes five times as long for a few of them."""
    return np.count_nonzero(flags) > 0


def moving_body(position_m: FloatArray, velocity_m_s: FloatArray, yaw_rad: FloatArray | None = None) -> Body:
    """Return a body; its yaw is 0 if its orientation does not matter."""
    return Body(position_m, velocity_m_s, np.zeros_like(position_m[:, 0]) if yaw_rad is None else yaw_rad)


def resting_body(position_m: FloatArray, yaw_rad: FloatArray | None = None) -> Body:
    """Return a body at rest, or a place."""
    return moving_body(position_m, np.zeros_like(position_m), yaw_rad)


def yaw_rad(quaternion_wxyz: FloatArray) -> FloatArray:
    """Return the (B,) angle in (-π, π] about world z by which the x axis of (B, 4) rotations is turned."""
    w, x, y, z = quaternion_wxyz.T
    sine, cosine = 2 * (x * y + w * z), 1 - 2 * (y * y + z * z)
    # Experts act on it, so it is torch's: numpy's differs in the last bit, and so would their episodes.
    return torch.atan2(torch.from_numpy(sine), torch.from_numpy(cosine)).numpy()


def wrapped_rad(angle_rad: FloatArray) -> FloatArray:
    """Return the same angles in [-π, π)."""
    turn, half = np.float32(2 * np.pi), np.float32(np.pi)
    wrapped: FloatArray = np.remainder(angle_rad + half, turn) - half
    return wrapped
