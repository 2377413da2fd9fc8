"""From where the tool is to be to the joint positions that bring it there, learned from the demonstrations.

For the control mode `pd_joint_pos`. Where the arm goes is predicted in space, as for the other modes; which
joints that takes is one smooth map, the same wherever the target lies. It is learned with the rest: while an
arm waits, its targets are its joints.
"""

import math

import torch
from torch import Tensor, nn

from vla_eval.models.episodes.config import POSITION_SCALE, SPACE
from vla_eval.models.memory.action_head import three_layers

N_JOINTS = 7
JOINT_UNIT_RAD = 0.1  # joints to numbers that change by about 1 in a step, as actions of the other modes do
STEP_M = 0.1  # 1 of a translation, as in those
ROTATION = 6  # numbers of the state that say how the tool is turned, after its position
JOINT_HIDDEN = 128
# About which the joints move: where the tasks' episodes begin.
REST_RAD = (0.0, 0.0, 0.0, -2 * math.pi / 3, 0.0, 2 * math.pi / 3, math.pi / 4)


class JointLayer(nn.Module):
    """A place of the tool and its orientation to joint positions, in units of `JOINT_UNIT_RAD`."""

    rest: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.joints = three_layers(SPACE + ROTATION, JOINT_HIDDEN, N_JOINTS)
        self.register_buffer("rest", torch.tensor(REST_RAD) / JOINT_UNIT_RAD, persistent=False)

    def forward(self, actions: Tensor, state: Tensor) -> Tensor:
        """Return actions (N, chunk, N_JOINTS + rest of an action).

        Those that are given begin with a translation from the present place; the state (N, state) begins with
        the tool's position in metres and two columns of its rotation matrix.
        """
        place_m = state[:, None, :SPACE] + STEP_M * actions[..., :SPACE]
        turned = state[:, None, SPACE : SPACE + ROTATION].expand(-1, actions.shape[1], -1)
        joints = self.rest + self.joints(torch.cat([place_m * POSITION_SCALE, turned], dim=-1))
        return torch.cat([joints, actions[..., SPACE:]], dim=-1)


def action_units(*, joint_targets: bool, action: int) -> Tensor:
    """Return (action,): what 1 in the network's actions is in the environment's."""
    units = torch.ones(action)
    if joint_targets:
        units[:N_JOINTS] = JOINT_UNIT_RAD
    return units
