"""The state of a body for privileged readers: position, velocity, yaw."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from vla_eval.task_state import BodyState


class Body(NamedTuple):
    """Position (B, 3) in m, linear velocity (B, 3) in m/s and yaw (B,) in rad, world frame."""

    position_m: torch.Tensor
    velocity_m_s: torch.Tensor
    yaw_rad: torch.Tensor

    def state(self, env: int) -> BodyState:
        """Return it in one parallel environment, as new numbers."""
        return BodyState(
            position_m=to_vector(self.position_m[env]),
            velocity_m_s=to_vector(self.velocity_m_s[env]),
            yaw_rad=float(self.yaw_rad[env]),
        )


def length(vectors: Any) -> torch.Tensor:  # Any: as for `to_vector`
    """Return the Euclidean length of the last dimension."""
    norm: torch.Tensor = torch.linalg.norm(vectors, dim=-1)
    return norm


def to_vector(tensor: Any) -> NDArray[np.float64]:  # Any: also what ManiSkill hands out, which is untyped
    """Return a tensor as new float64 numbers."""
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64).copy()


def moving_body(
    position_m: torch.Tensor, velocity_m_s: torch.Tensor, yaw_rad: torch.Tensor | None = None
) -> Body:
    """Return a body; its yaw is 0 if its orientation does not matter."""
    return Body(position_m, velocity_m_s, torch.zeros_like(position_m[:, 0]) if yaw_rad is None else yaw_rad)


def resting_body(position_m: torch.Tensor, yaw_rad: torch.Tensor | None = None) -> Body:
    """Return a body at rest, or a place."""
    return moving_body(position_m, torch.zeros_like(position_m), yaw_rad)


def yaw_rad(quaternion_wxyz: torch.Tensor) -> torch.Tensor:
    """Return the (B,) angle in (-π, π] about world z by which the x axis of (B, 4) rotations is turned."""
    w, x, y, z = quaternion_wxyz.unbind(dim=1)
    return torch.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def wrapped_rad(angle_rad: torch.Tensor) -> torch.Tensor:
    """Return the same angles in [-π, π)."""
    return torch.remainder(angle_rad + torch.pi, 2 * torch.pi) - torch.pi
