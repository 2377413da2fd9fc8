"""What a gripper's number means: ManiSkill's meaning and that of a policy. Knows only torch.

ManiSkill's `pd_ee_delta_pose`: +1 opens (fingers 4 cm from the middle), -1 closes, and what is between is a
width, so that 0 leaves a gap of 3 cm: the controller maps [-1, 1] to [-0.01, 0.04] m per finger.
Source: `gripper_pd_joint_pos`, the same in 3.0.1, of https://github.com/haosulab/ManiSkill/blob/
1abb221ab12ce09030d75509313a9641645f4354/mani_skill/agents/robots/panda/panda.py
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from vla_eval.errors import RecipeError, did_you_mean

GripperEncoding = Literal["maniskill", "unit_open", "unit_closed", "negated"]
"""A policy's own number.

- `maniskill`: -1 closed to +1 open, as the environment takes it.
- `unit_open`: 0 closed to 1 open.
- `unit_closed`: 0 open to 1 closed.
- `negated`: -1 open to +1 closed (LIBERO's).
"""
GripperDecoding = Literal["continuous", "binary", "paper_openvla"]
"""From the policy's number to the environment's.

- `continuous`: the inverse of the encoding.
- `binary`: that, then open or closed, whichever is nearer.
- `paper_openvla`: as the paper's public OpenVLA code does it. It trains on ManiSkill's number as it is and
  then executes -sign(2 g - 1), so that a predicted +1 (open) closes and -1 (closed) opens; 0.5 gives 0.
  Source: MIKASA-Robo, branch `openvla`, commit 528086e, experiments/robot/mikasa/run_mikasa_eval.py:253-263.
"""


class _Linear(NamedTuple):
    factor: float
    offset: float


_TO_POLICY: Mapping[GripperEncoding, _Linear] = {
    "maniskill": _Linear(1.0, 0.0),
    "unit_open": _Linear(0.5, 0.5),
    "unit_closed": _Linear(-0.5, 0.5),
    "negated": _Linear(-1.0, 0.0),
}
ENCODINGS: tuple[GripperEncoding, ...] = tuple(_TO_POLICY)
DECODINGS: tuple[GripperDecoding, ...] = ("continuous", "binary", "paper_openvla")


@dataclass(frozen=True, slots=True, kw_only=True)
class Gripper:
    """How a policy encodes the gripper, and how what it predicts is executed."""

    encoding: GripperEncoding = "maniskill"  # of the policy
    decoding: GripperDecoding = "continuous"  # from the policy to the environment
    dim: int = -1  # which dimension of the action is the gripper; -1 is the last

    def __post_init__(self) -> None:
        """Check the names, and that the faithful mode is used as the paper's code uses it."""
        for field, value, known in (
            ("encoding", self.encoding, ENCODINGS),
            ("decoding", self.decoding, DECODINGS),
        ):
            if value not in known:
                raise RecipeError(
                    f"gripper.{field} is '{value}'.{did_you_mean(value, known)} Known: {', '.join(known)}."
                )
        if self.decoding == "paper_openvla" and self.encoding != "maniskill":
            raise RecipeError(
                f"gripper.decoding paper_openvla goes with encoding maniskill, found '{self.encoding}': the "
                f"paper's code trains on ManiSkill's number as it is."
            )

    def encode(self, actions: Tensor) -> Tensor:
        """Return the environment's actions (…, A) with the policy's gripper; for training targets."""
        factor, offset = _TO_POLICY[self.encoding]
        return self._replaced(actions, actions[..., self.dim] * factor + offset)

    def decode(self, actions: Tensor) -> Tensor:
        """Return predicted actions (…, A), no more normalised, as the environment takes them."""
        predicted = actions[..., self.dim]
        if self.decoding == "paper_openvla":
            return self._replaced(actions, -torch.sign(2 * predicted - 1))
        factor, offset = _TO_POLICY[self.encoding]
        value = (predicted - offset) / factor
        if self.decoding == "binary":
            value = torch.where(value >= 0, 1.0, -1.0).to(value.dtype)
        return self._replaced(actions, value)

    def _replaced(self, actions: Tensor, value: Tensor) -> Tensor:
        changed = actions.clone()
        changed[..., self.dim] = value
        return changed
