"""Plain encoders of images: the one of the paper's baselines, and keypoints of shapes and of colours."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any  # torch's context of a function is untyped

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from vla_eval.models.sequence.sizes import ENCODERS, NATURE_LAYERS, nature_edges
from vla_eval.models.shared.images import in_numbers
from vla_eval.models.shared.precision import in_float32

RGB = 3
NUMBERS_OF_A_KEYPOINT = 3  # x, y, how strong
CELL_PX = 4
FRAMES_AT_ONCE = 64  # on a CPU


class Nature(nn.Sequential):
    """The encoder of the paper's sequence baselines: three convolutions, a linear layer, tanh.

    Sizes: Mnih et al. 2015, as in https://github.com/CognitiveAISystems/RATE (commit 5aa88f0, image encoder
    of the MIKASA-Robo configurations), which has both cameras as six channels.
    """

    def __init__(self, *, image_px: int, outputs: int, channels: int = RGB) -> None:
        (first, second, third), edge = NATURE_LAYERS, nature_edges(image_px)[-1]
        super().__init__(
            nn.Conv2d(channels, 32, *first),
            nn.ReLU(),
            nn.Conv2d(32, 64, *second),
            nn.ReLU(),
            nn.Conv2d(64, 64, *third),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(64 * edge**2, outputs),
            nn.Tanh(),
        )


SHAPE_MAPS, COLOR_MAPS = 32, 64


def _shapes() -> nn.Sequential:
    """Two convolutions, and one of 1 x 1."""
    return nn.Sequential(
        nn.Conv2d(RGB, 32, 2 * CELL_PX, stride=CELL_PX, padding=2),
        nn.ReLU(),
        nn.Conv2d(32, 32, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(32, SHAPE_MAPS, 1),
    )


class ShapesAndColors(nn.Module):
    """Beside the maps of convolutions, some of each cell's mean colour (docs/learning_the_rule.md)."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes = _shapes()
        self.colors = nn.Sequential(
            nn.AvgPool2d(CELL_PX),
            nn.Conv2d(RGB, 64, 1),
            nn.ReLU(),
            nn.Conv2d(64, 64, 1),
            nn.ReLU(),
            nn.Conv2d(64, COLOR_MAPS, 1),
        )

    def forward(self, images: Tensor) -> Tensor:
        """Return (N, maps, H / 4, W / 4) of images (N, 3, H, W)."""
        return torch.cat([self.shapes(images), self.colors(images)], dim=1)


FEATURES: Mapping[str, tuple[Callable[[], nn.Module], int]] = {
    "keypoints": (_shapes, SHAPE_MAPS),
    "color_keypoints": (ShapesAndColors, SHAPE_MAPS + COLOR_MAPS),
}
"""Name -> features of each cell of 4 x 4 pixels, and how many maps they are."""


class Keypoints(nn.Module):
    """Features of each cell of 4 x 4 pixels and a spatial softmax: where each is, and how strong it is there.

    Levine et al. 2016, "End-to-End Training of Deep Visuomotor Policies", section 5.1; the strength, which
    says whether the feature is in the image at all, is ours.
    """

    places: Tensor

    def __init__(self, *, image_px: int, outputs: int, features: str = "keypoints") -> None:
        super().__init__()
        make, n_maps = FEATURES[features]
        self.features = make()
        self.sharpness = nn.Parameter(torch.full((n_maps,), 4.0).log())
        self.reads = nn.Linear(NUMBERS_OF_A_KEYPOINT * n_maps, outputs)
        line = torch.linspace(-1, 1, image_px // CELL_PX)
        places = torch.cartesian_prod(line, line).flip(-1)  # (H · W, 2): x, y
        self.register_buffer("places", places, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Return (N, outputs) of images (N, 3, H, W) in [-1, 1]."""
        return self.reads_out(self.features(images))

    @in_float32
    def reads_out(self, features: Tensor) -> Tensor:
        """Return (N, outputs) of maps (N, maps, H, W); half precision would round places to a pixel."""
        # In one piece: after convolutions in channels_last order, a map's numbers are far apart.
        maps = features.flatten(2).contiguous()
        found = spatial_softmax(maps, self.sharpness.exp(), self.places)
        read: Tensor = self.reads(found.transpose(1, 2).flatten(1))  # all x, all y, all strengths
        return read


class Cameras(nn.ModuleList):
    """The images of all cameras as one vector: an encoder for each, or one whose channels they all are."""

    def __init__(self, name: str, *, n_cameras: int, image_px: int, outputs: int) -> None:
        channels = RGB * n_cameras if ENCODERS[name] else RGB
        n_encoders = RGB * n_cameras // channels
        self.outputs = n_encoders * outputs
        make: Callable[..., nn.Module] = (
            partial(Keypoints, features=name) if name in FEATURES else partial(Nature, channels=channels)
        )
        super().__init__(make(image_px=image_px, outputs=outputs) for _ in range(n_encoders))

    def forward(self, images: Tensor) -> Tensor:
        """Return (B, T, `outputs`) of images (B, T, cameras, 3, H, W), in [0, 1] or bytes.

        On a CPU, 64 frames at a time. In training their number differs from step to step; maps of ever new
        sizes would find no room where those of the last step were, and the process would grow and grow.
        """
        frames = images.flatten(0, 1)
        at_once = FRAMES_AT_ONCE if images.device.type == "cpu" else len(frames)
        seen = torch.cat([self._seen(part) for part in torch.split(frames, at_once)])
        return seen.reshape(*images.shape[:2], self.outputs)

    def _seen(self, frames: Tensor) -> Tensor:
        """Return (N, `outputs`) of frames (N, cameras, 3, H, W)."""
        parts = frames.flatten(1, 2).chunk(len(self), dim=1)
        # Convolutions on a CPU are a fifth faster in this order of the same numbers.
        ordered = (part.contiguous(memory_format=torch.channels_last) for part in parts)
        return torch.cat(
            [encoder(_around_zero(part)) for encoder, part in zip(self, ordered, strict=True)], dim=-1
        )


def _around_zero(images: Tensor) -> Tensor:
    """Return images in [-1, 1] of images in [0, 1] or bytes, the same numbers of both."""
    if images.dtype == torch.uint8:  # a new tensor, so that the rest can be done in place: it is large
        return in_numbers(images).mul_(2).sub_(1)
    return 2 * images - 1


LEAST_VARIANCE = 1e-5  # as torch's instance_norm


def spatial_softmax(maps: Tensor, sharpness: Tensor, places: Tensor) -> Tensor:
    """Return (N, maps, 3): x, y and value of maps (N, maps, P) at places (P, 2), weighted by the softmax."""
    found: Tensor = _SpatialSoftmax.apply(maps, sharpness, places)  # type: ignore[no-untyped-call]
    return found


class _SpatialSoftmax(torch.autograd.Function):
    """With a the maps less their mean μ and s the sharpness over their deviation: p = softmax(a · s).

    It returns the sum over all places of p · (x, y, a + μ). Written out with its gradient: these maps are
    most of what a training step moves through memory, and autograd keeps and passes over twice as many.
    """

    @staticmethod
    def forward(context: Any, maps: Tensor, sharpness: Tensor, places: Tensor) -> Tensor:
        mean = maps.mean(dim=-1, keepdim=True)
        around = maps - mean
        variance = torch.linalg.vector_norm(around, dim=-1, keepdim=True).square() / maps.shape[-1]
        per_deviation = (variance + LEAST_VARIANCE).rsqrt()
        shares = (around * (sharpness[:, None] * per_deviation)).softmax(dim=-1)
        found = torch.cat([shares @ places, (shares * around).sum(dim=-1, keepdim=True)], dim=-1)
        context.save_for_backward(around, per_deviation, shares, found, sharpness, places)
        return torch.cat([found[..., :2], found[..., 2:] + mean], dim=-1)

    @staticmethod
    @once_differentiable
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        around, per_deviation, shares, found, sharpness, places = context.saved_tensors
        n_places = around.shape[-1]
        of_place, of_strength = gradient[..., :2], gradient[..., 2:]
        scale = sharpness[:, None] * per_deviation
        # Of the softmax's inputs: each share times what it gives beyond the mean of all.
        inputs = (of_place @ places.T).addcmul_(around, of_strength)
        inputs.sub_((gradient * found).sum(dim=-1, keepdim=True)).mul_(shares)
        of_scale = (inputs * around).sum(dim=-1, keepdim=True)
        # Through the deviation, too, and through the strength itself.
        through_deviation = of_scale * scale * per_deviation.square() / -n_places
        of_maps = inputs.mul_(scale).addcmul_(around, through_deviation).addcmul_(shares, of_strength)
        # Of what is subtracted as the mean, the strength alone gets it back.
        of_maps.sub_(of_maps.mean(dim=-1, keepdim=True) - of_strength / n_places)
        return of_maps, (of_scale * per_deviation).sum(dim=(0, 2)), None
