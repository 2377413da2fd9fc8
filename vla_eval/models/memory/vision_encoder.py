"""The vision encoder of the positive control: places of an image, what stands out, what is alike."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.memory.sizes import APART, HALVES, KNOWN, PLACE, QUARTERS, RGB, SPOTS, NetworkSizes
from vla_eval.models.shared.precision import in_float32

# How much differences count when something is looked for, to begin with. Colours in [-1, 1]: a maroon cube
# beside the red one that is asked for differs by about 1 in one of three, and gets e^-40 of the attention.
COUNT_APART, COUNT_LOOKS, COUNT_OTHERS = 4.0, 40.0, -3.0  # before softplus
LEAST_COLOR_VARIANCE = 1e-3  # colours in [-1, 1]: less than this is noise of the image


class Places(NamedTuple):
    """What the encoder extracts at P places, or what was looked at there."""

    features: Tensor  # (N, P, channels) learned ones of each place
    # (N, P · QUARTERS, KNOWN) the known numbers of one spot of each quarter, place by place
    spots: Tensor

    def look(self, shares: Tensor) -> Tensor:
        """Return what is seen, (N, heads, value), if attention (N, heads, P · QUARTERS) goes to the spots."""
        of_places = shares.reshape(*shares.shape[:2], -1, QUARTERS).sum(dim=-1)
        return torch.cat([of_places @ self.features, shares @ self.spots], dim=-1)

    def strongest(self) -> Tensor:
        """Return (N, value): the largest of each number in the image."""
        return torch.cat([self.features.amax(dim=1), self.spots.amax(dim=1)], dim=-1)


class VisionEncoder(nn.Module):
    """One camera's image to features of places, and the known numbers of one spot of each quarter.

    It is the spot, half of the quarter's edge wide, whose colour stands out most from the image's: a cube
    of 4 pixels keeps its colour in a place of 8, and so does the one beside it.
    """

    coordinates: Tensor

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.patch_px = sizes.patch_px
        width = sizes.channels
        self.patches = nn.Conv2d(RGB, width, sizes.patch_px, stride=sizes.patch_px)
        self.around = nn.Conv2d(width, width, 3, padding=1)
        self.mix = nn.Conv2d(width, width, 1)
        line = torch.linspace(-1, 1, SPOTS * sizes.image_px // sizes.patch_px)
        y, x = torch.meshgrid(line, line, indexing="ij")
        self.register_buffer("coordinates", torch.stack([x, y]), persistent=False)

    def forward(self, images: Tensor) -> Places:
        """Look at images (N, 3, H, W) in [0, 1]."""
        centred = 2 * images - 1
        features = self.patches(centred)
        features = features + self.mix(functional.gelu(self.around(functional.gelu(features))))
        return Places(features.float().flatten(2).transpose(1, 2), self._known(centred))

    @torch.no_grad()
    @in_float32
    def _known(self, images: Tensor) -> Tensor:
        """(N, 3, H, W) in [-1, 1] to (N, P · QUARTERS, KNOWN), place by place."""
        colors = functional.avg_pool2d(images, self.patch_px // SPOTS)
        apart = standing_out(colors)
        quarters = functional.max_pool2d(apart, SPOTS // HALVES, return_indices=True)[1]
        edge = quarters.shape[-1] // HALVES
        chosen = quarters.reshape(-1, edge, HALVES, edge, HALVES).transpose(2, 3).flatten(1)
        placed = self.coordinates.expand(len(images), -1, -1, -1)
        known = torch.cat([apart, colors, placed], dim=1).flatten(2)
        return known.gather(2, chosen[:, None].expand(-1, KNOWN, -1)).transpose(1, 2)


def standing_out(colors: Tensor) -> Tensor:
    """Return (N, 1, H, W): how unlike an image's other colours each colour (N, 3, H, W) is.

    Half the logarithm of 1 + its squared Mahalanobis distance from the image's mean (Reed and Yu 1990).
    """
    apart = colors.flatten(2) - colors.flatten(2).mean(dim=2, keepdim=True)
    variance = apart @ apart.transpose(1, 2) / apart.shape[2]
    variance = variance + LEAST_COLOR_VARIANCE * torch.eye(RGB, dtype=colors.dtype, device=colors.device)
    squared: Tensor = (apart * torch.linalg.solve(variance, apart)).sum(dim=1)
    return squared.log1p().div(2).reshape(len(colors), 1, *colors.shape[2:])


class Keys(nn.Module):
    """What of a place counts when it is looked for: learned numbers, and the known ones."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.learned = nn.Linear(sizes.value, sizes.key)

    def forward(self, places: Places) -> Tensor:
        """Return the keys of the spots, (N, P · QUARTERS, key + KNOWN)."""
        features, spots = places
        weight = self.learned.weight
        of_place = functional.linear(features, weight[:, :-KNOWN], self.learned.bias)
        learned = of_place.repeat_interleave(QUARTERS, dim=1) + functional.linear(spots, weight[:, -KNOWN:])
        return torch.cat([learned, spots], dim=-1)

    def of(self, values: Tensor) -> Tensor:
        """Return the keys of what was seen (…, value), (…, key + KNOWN)."""
        return torch.cat([self.learned(values), values[..., -KNOWN:]], dim=-1)


class StandingOut(nn.Module):
    """Looks at what stands out of the image, in a way of its own per head."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        n = sizes.key + KNOWN
        self.towards = nn.Parameter(torch.randn(sizes.heads, n) / math.sqrt(n))
        with torch.no_grad():  # to begin with: what stands out e^1 more gets e^20 of the attention
            self.towards[:, sizes.key] += 20.0

    def forward(self, places: Places, keys: Tensor) -> Tensor:
        """Places and the keys of their spots to what each head saw, (N, heads, value)."""
        return places.look((keys @ self.towards.T).transpose(1, 2).softmax(dim=-1))


class Found(NamedTuple):
    """What look-ups found, (N, heads, value), and the evidence for each, (N, heads, 3)."""

    values: Tensor
    evidence: Tensor


class Likeness(nn.Module):
    """Looks at what is like that which was asked for; each head has its own notion of likeness."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.counts = nn.Parameter(torch.full((sizes.heads, sizes.key + KNOWN), COUNT_OTHERS))
        color = sizes.key + APART
        with torch.no_grad():  # to begin with, half of the heads ask for a colour, half for a place
            self.counts[:, sizes.key] = COUNT_APART
            self.counts[: sizes.heads // 2, color : color + RGB] = COUNT_LOOKS
            self.counts[sizes.heads // 2 :, color + RGB :] = COUNT_LOOKS

    def forward(self, places: Places, keys: Tensor, asked: Tensor) -> Found:
        """Look for what is asked, (N, heads, key + KNOWN), among keys (N, P · QUARTERS, key + KNOWN)."""
        counts = functional.softplus(self.counts)
        # Minus the squared distance, without what all places have in common.
        scores = keys @ (2 * asked * counts).transpose(1, 2) - keys.square() @ counts.T
        shares = scores.transpose(1, 2).softmax(dim=-1)
        values = places.look(shares)
        color = slice(-RGB - PLACE, -PLACE)  # of values and of keys
        unlike = (values[..., color] - asked[..., color]).square().sum(dim=-1)
        return Found(values, torch.stack([shares.amax(dim=-1), values[..., -KNOWN], -unlike], dim=-1))
