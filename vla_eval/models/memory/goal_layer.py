"""Where the positive control goes, from what its look-ups found: docs/positive_control.md, “Goal”."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vla_eval.models.episodes.config import POSITION_SCALE, SPACE
from vla_eval.models.memory.action_head import three_layers
from vla_eval.models.memory.sizes import PLACE

MAP_HIDDEN = 64
EVIDENCE_COUNTS = (3.0, 0.5, 3.0)
"""How much the evidence for a look-up counts to begin with: its largest share of attention, how much the
place stands out, and minus how unlike its colour is to the one asked for."""

PLACE_SCALE = 4.0  # the table's things lie within a part of an image of [-1, 1]: to numbers of about 1
LEAST_HEIGHT_M = 0.02
LEAST_ERROR_M2 = 1e-8  # a camera without error would be believed alone
KEPT_PER_BATCH = 0.95  # of the earlier estimates of errors and evidence
TRUST_SCALE = 10.0  # so that an optimizer's steps of 0.002 stop listening within some hundred


class Goals(NamedTuple):
    """Where to go."""

    pointed: Tensor  # (N, cameras, heads, 3) by each look-up alone
    shares: Tensor  # (N, cameras, heads) how far each is believed among those of its camera; of sum 1
    camera_shares: Tensor  # (N, cameras) how far each camera is; of sum 1
    evidence: Tensor  # (N, cameras, 3) for each camera

    @property
    def alone(self) -> Tensor:
        """(N, cameras, 3) by each camera alone."""
        return by_camera(self.pointed, self.shares)

    @property
    def together(self) -> Tensor:
        """(N, 3) by all of them."""
        return (self.camera_shares[..., None] * self.alone).sum(dim=1)


class GoalLayer(nn.Module):
    """The mean of where the look-ups point to, weighted by how far each is believed: by camera, then of both.

    The map of a fixed camera knows nothing but the place in the image. For a camera on the arm (`on_arm`),
    such a place is a ray that leaves the tool: where it meets the table depends on the tool's height alone,
    linearly, and turns and moves with the tool. In training, how far each camera is believed is learned with
    the rest. When it acts, cameras are weighed by the inverse of the variance of their errors: that of a
    fixed camera is a number, that of a ray grows with the square of its length, both medians over training.
    """

    usual_error: Tensor
    usual_evidence: Tensor
    rides: Tensor

    def __init__(self, *, on_arm: Sequence[bool], heads: int) -> None:
        super().__init__()
        cameras = len(on_arm)
        self.on_arm = tuple(on_arm)
        self.maps = nn.ModuleList(
            three_layers(PLACE, MAP_HIDDEN, (2 * SPACE if rides else SPACE) + 1) for rides in on_arm
        )
        self.trust = nn.Parameter(torch.zeros(cameras, heads))
        self.evidence = nn.Parameter(torch.tensor(EVIDENCE_COUNTS).repeat(cameras, heads, 1))
        self.camera_trust = nn.Parameter(torch.zeros(cameras))
        self.camera_evidence = nn.Parameter(torch.tensor(EVIDENCE_COUNTS).repeat(cameras, 1))
        self.register_buffer("usual_error", torch.ones(cameras))
        self.register_buffer("usual_evidence", torch.zeros(cameras, len(EVIDENCE_COUNTS)))
        self.register_buffer("rides", torch.tensor(self.on_arm), persistent=False)

    def forward(self, places: Tensor, evidence: Tensor, state: Tensor) -> Goals:
        """Return the goals in metres.

        `places` (N, cameras, heads, 2) are -1 to 1; for `evidence` see `EVIDENCE_COUNTS`. `state` (N, state)
        begins with the tool's position and the first two columns of its rotation matrix.
        """
        mapped = [each(PLACE_SCALE * places[:, index]) for index, each in enumerate(self.maps)]
        pointed = torch.stack(
            [
                _from_the_tool(camera[..., 1:], state) if rides else camera[..., 1:] / POSITION_SCALE
                for camera, rides in zip(mapped, self.on_arm, strict=True)
            ],
            dim=1,
        )
        sure = torch.stack([camera[..., 0] for camera in mapped], dim=1)
        belief = TRUST_SCALE * self.trust + (self.evidence * evidence).sum(dim=-1) + sure
        shares = belief.softmax(dim=-1)
        of_camera = (shares[..., None] * evidence).sum(dim=2)
        if self.training:
            believed = TRUST_SCALE * self.camera_trust + (self.camera_evidence * of_camera).sum(dim=-1)
            believed = believed + (shares * sure).sum(dim=-1)
        else:
            unusual = (self.camera_evidence * (of_camera - self.usual_evidence)).sum(dim=-1)
            believed = unusual - (self.usual_error * self._squared_length(state)).log()
        return Goals(pointed, shares, believed.softmax(dim=-1), of_camera)

    @torch.no_grad()
    def note_errors(self, missed_m: Tensor, evidence: Tensor, state: Tensor) -> None:
        """Note by which evidence each camera's goals missed, (N, cameras, 3), at N steps, see `Goals`."""
        squared = missed_m.square().sum(dim=-1) / self._squared_length(state)
        for usual, now in (
            (self.usual_error, squared.median(dim=0).values.clamp(min=LEAST_ERROR_M2)),
            (self.usual_evidence, evidence.median(dim=0).values),
        ):
            usual.lerp_(now, 1 - KEPT_PER_BATCH)

    def _squared_length(self, state: Tensor) -> Tensor:
        """(N, cameras) of the ray in square metres; 1 for a fixed camera."""
        height_m = state[:, SPACE - 1 : SPACE].clamp(min=LEAST_HEIGHT_M)
        return torch.where(self.rides, height_m.square(), torch.ones_like(height_m))


def by_camera(pointed: Tensor, shares: Tensor) -> Tensor:
    """Return the goals (…, cameras, 3) of each camera's look-ups (…, cameras, heads, 3), by their shares."""
    return (shares[..., None] * pointed).sum(dim=-2)


def _from_the_tool(rays: Tensor, state: Tensor) -> Tensor:
    """Return (N, heads, 3) m where rays meet the table: an offset from the tool, another per unit height."""
    height = POSITION_SCALE * state[:, None, SPACE - 1 : SPACE]
    from_tool = (rays[..., :SPACE] + height * rays[..., SPACE:]) / POSITION_SCALE
    first, second = state[:, SPACE : 2 * SPACE], state[:, 2 * SPACE : 3 * SPACE]
    turned = torch.stack(
        [first, second, torch.linalg.cross(first, second)], dim=1
    )  # (N, 3, 3), its transpose
    return state[:, None, :SPACE] + from_tool @ turned
