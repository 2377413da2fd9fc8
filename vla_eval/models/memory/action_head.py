"""The last layers of the positive control, from the goal to a chunk: docs/positive_control.md, “Action”."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.episodes.config import POSITION_SCALE, SPACE

WAY_SCALE_M = 0.1  # metres of a way to numbers of about 1
WAY_HIDDEN = 64
WAY_SEEN = 4  # numbers that describe the way along one axis
LEAST_DOUBT = 1e-4  # squared error of an action in [-1, 1]


def three_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Return a map from numbers to numbers with two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU(), nn.Linear(hidden, outputs)
    )


class ActionHead(nn.Module):
    """Decides when to go, the action, and its expected error; `free`: translation needs no goal."""

    upright: Tensor

    def __init__(self, *, hidden: int, chunk: int, action: int, free: bool) -> None:
        super().__init__()
        self.chunk = chunk
        self.free = nn.Linear(hidden, chunk * SPACE) if free else None
        self.goes = nn.Linear(hidden, chunk)
        self.way = three_layers(WAY_SEEN, WAY_HIDDEN, chunk)
        self.others = nn.Linear(hidden, chunk * (action - SPACE))
        self.doubts = nn.Linear(hidden, chunk)
        self.register_buffer("upright", torch.eye(SPACE)[-1], persistent=False)
        with torch.no_grad():
            self.doubts.bias.fill_(-3.0)  # about the error of actions at the beginning

    def forward(self, decided: Tensor, way_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (N, chunk, action), and the squared error expected of each (N, chunk) > 0."""
        goes = self.goes(decided).sigmoid()[..., None]  # (N, chunk, 1)
        ways = self.way(self._along_each_axis(way_m)).transpose(1, 2)  # (N, chunk, 3)
        others = self.others(decided).reshape(len(decided), self.chunk, -1)
        doubts = functional.softplus(self.doubts(decided.detach())) + LEAST_DOUBT
        translation = goes * ways
        if self.free is not None:
            translation = translation + self.free(decided).reshape(translation.shape)
        return torch.cat([translation, others], dim=-1), doubts

    def _along_each_axis(self, way_m: Tensor) -> Tensor:
        """(N, 3) to (N, 3, WAY_SEEN): way along the axis, up, aside, kind of axis; x and y share weights."""
        way = way_m / WAY_SCALE_M
        up, aside = way[:, 2:], way[:, :2].norm(dim=1, keepdim=True)
        shared = torch.cat([up, aside], dim=1)[:, None].expand(-1, SPACE, -1)
        kind = self.upright.expand(len(way), -1)
        return torch.cat([way[..., None], shared, kind[..., None]], dim=-1)


N_JOINTS = 7
JOINT_UNIT_RAD = 0.1  # joints to numbers that change by about 1 in a step, as actions of the other modes do
STEP_M = 0.1  # 1 of a translation, as in those
ROTATION = 6  # numbers of the state that say how the tool is turned, after its position
JOINT_HIDDEN = 128
# About which the joints move: where the tasks' episodes begin.
REST_RAD = (0.0, 0.0, 0.0, -2 * math.pi / 3, 0.0, 2 * math.pi / 3, math.pi / 4)


class JointLayer(nn.Module):
    """A place of the tool and its orientation to joint positions, in units of `JOINT_UNIT_RAD`.

    For `pd_joint_pos`. Where the arm goes is predicted in space, as for the other modes; which joints that
    takes is one smooth map. It is learned with the rest: while an arm waits, its targets are its joints.
    """

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
