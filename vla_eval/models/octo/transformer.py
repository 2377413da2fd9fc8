"""Octo's transformer: images, instruction and readouts as tokens, each step sees itself and the past.

Legend of shape suffixes: B batch, W steps of the window, N tokens, L tokens of the instruction, D width.
Knows only torch: nothing of lerobot, of text, or of actions.

Source of all constants and rules: https://github.com/octo-models/octo at
241fb3514b7c40957a86d869fecb7c7fc353f540 (MIT), octo/model/octo_module.py, octo/model/components/
{block_transformer,transformer,vit_encoders,tokenizers}.py; our own implementation.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.octo.diffusion_head import DiffusionHead, HeadSizes

NORM_EPSILON = 1e-6  # flax's default, of layer and group norms; torch's is 1e-5
STANDARDIZATION_EPSILON = 1e-5  # vit_encoders.py: StdConv
N_NORM_GROUPS = 32  # flax's default of GroupNorm
MIDDLE_LEVEL = 127.5  # levels [0, 255] become [-1, 1]
POSITION_STD = 0.02  # of initial position embeddings
PATCH_PX = 16  # four convolutions of stride 2


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformerSizes:
    """What the transformer is made of; the defaults are those of Octo-small."""

    # camera of the model -> edge of its square images, in the order of the tokens
    image_px: Mapping[str, int]
    max_window: int = 10  # longest window that there are position embeddings for
    # `language_tokens`, `language_width`: of the embedded instruction
    language_tokens: int = 16
    language_width: int = 768
    width: int = 384
    layers: int = 12
    heads: int = 6
    mlp_width: int = 1536
    stem_channels: tuple[int, ...] = (32, 96, 192, 384)
    stem_features: int = 512


class Window(NamedTuple):
    """What the transformer reads."""

    images: Mapping[str, Tensor]  # camera -> (B, W, 3, px, px) in levels [0, 255]
    image_mask: Mapping[str, Tensor]  # camera -> (B, W), False where a camera gave no image
    step_mask: Tensor  # (B, W), False for steps before the episode began
    language_BLD: Tensor
    language_mask: Tensor  # (B,), False where there is none


class Outputs(NamedTuple):
    """Output of the transformer: embeddings of the instruction, by group of each step, and the readout."""

    task_BLD: Tensor
    groups: dict[str, Tensor]  # (B, W, N, D)
    readout_BWD: Tensor


class StandardizedConv2d(nn.Conv2d):
    """A convolution whose weights have mean 0 and standard deviation 1 for each output."""

    def forward(self, x: Tensor) -> Tensor:
        """Convolve."""
        weight = self.weight - self.weight.mean(dim=(1, 2, 3), keepdim=True)
        deviation = weight.std(dim=(1, 2, 3), keepdim=True, correction=0)  # of the population, as in numpy
        return functional.conv2d(
            x, weight / (deviation + STANDARDIZATION_EPSILON), self.bias, self.stride, self.padding
        )


class Stem(nn.Module):
    """One token per 16×16 pixels; there is no goal image, which is zeros, hence -1."""

    def __init__(self, channels: tuple[int, ...], features: int) -> None:
        super().__init__()
        inputs = (6, *channels[:-1])
        self.convolutions = nn.ModuleList(
            StandardizedConv2d(n_in, n_out, 3, stride=2, padding=1)
            for n_in, n_out in zip(inputs, channels, strict=True)
        )
        self.norms = nn.ModuleList(nn.GroupNorm(N_NORM_GROUPS, n, eps=NORM_EPSILON) for n in channels)
        self.embedding = nn.Conv2d(channels[-1], features, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Return tokens (B, W, N, features), row by row, of images (B, W, 3, px, px) in [0, 255]."""
        scaled = images.flatten(0, 1) / MIDDLE_LEVEL - 1
        x = torch.cat([scaled, torch.full_like(scaled, -1.0)], dim=1)
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = functional.relu(norm(convolution(x)))
        tokens = self.embedding(x).flatten(2).transpose(1, 2)
        return tokens.unflatten(0, images.shape[:2])  # type: ignore[no-any-return]


class Block(nn.Module):
    """Attention and a feed-forward part, each behind a norm and with a shortcut."""

    def __init__(self, width: int, heads: int, mlp_width: int) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.query, self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(4))
        self.mlp_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.fc1, self.fc2 = nn.Linear(width, mlp_width), nn.Linear(mlp_width, width)

    def forward(self, x_BND: Tensor, mask: Tensor) -> Tensor:
        """Return the next embeddings; `mask` (B, 1, N, N): which place (third) attends to which (fourth)."""
        normed = self.attention_norm(x_BND)
        query, key, value = (
            part(normed).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in (self.query, self.key, self.value)
        )
        seen = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        x_BND = x_BND + self.out(seen.transpose(1, 2).flatten(2))
        # flax's gelu is the tanh approximation.
        inner = functional.gelu(self.fc1(self.mlp_norm(x_BND)), approximate="tanh")
        return x_BND + self.fc2(inner)  # type: ignore[no-any-return]


class OctoTransformer(nn.Module):
    """See the module's text."""

    def __init__(self, sizes: TransformerSizes) -> None:
        super().__init__()
        self.sizes = sizes
        width = sizes.width
        self.stems = nn.ModuleDict(
            {camera: Stem(sizes.stem_channels, sizes.stem_features) for camera in sizes.image_px}
        )
        self.projections = nn.ModuleDict(
            {camera: nn.Linear(sizes.stem_features, width) for camera in sizes.image_px}
        )
        self.image_positions = nn.ParameterDict(
            {
                camera: _positions(1, sizes.max_window, (px // PATCH_PX) ** 2, width)
                for camera, px in sizes.image_px.items()
            }
        )
        self.language_projection = nn.Linear(sizes.language_width, width)
        self.language_positions = _positions(1, sizes.language_tokens, width)
        self.readout_positions = _positions(1, sizes.max_window, 1, width)
        self.blocks = nn.ModuleList(Block(width, sizes.heads, sizes.mlp_width) for _ in range(sizes.layers))
        self.norm = nn.LayerNorm(width, eps=NORM_EPSILON)

    def image_tokens(self, window: Window) -> dict[str, Tensor]:
        """Return camera -> (B, W, N, stem features); an image that is not there is black before."""
        return {
            camera: self.stems[camera](images * window.image_mask[camera][..., None, None, None])
            for camera, images in window.images.items()
        }

    def forward(self, window: Window) -> Outputs:
        """Return what each token has become."""
        n_steps = window.step_mask.shape[1]
        task_BLD = self.language_projection(window.language_BLD) + self.language_positions
        groups, masks = {}, {}
        for camera, tokens in self.image_tokens(window).items():
            embedded = self.projections[camera](tokens) + self.image_positions[camera][:, :n_steps]
            groups[camera] = embedded
            real = window.step_mask & window.image_mask[camera]
            masks[camera] = real[..., None].expand(embedded.shape[:3])
        # The instruction is repeated at each step, without a further position, and never padded by steps.
        groups["language"] = task_BLD[:, None].expand(-1, n_steps, -1, -1)
        language = window.language_mask[:, None, None]
        masks["language"] = language.expand(groups["language"].shape[:3])
        readout = self.readout_positions[:, :n_steps].expand(len(task_BLD), -1, -1, -1)
        steps_BWND = torch.cat([*groups.values(), readout], dim=2)
        keys = torch.cat([*masks.values(), torch.ones_like(readout[..., 0], dtype=torch.bool)], dim=2)
        task_keys = window.language_mask[:, None].expand(task_BLD.shape[:2])
        mask = attention_mask(torch.cat([task_keys, keys.flatten(1)], dim=1), task_BLD.shape[1], n_steps)
        x_BND = torch.cat([task_BLD, steps_BWND.flatten(1, 2)], dim=1)
        for block in self.blocks:
            x_BND = block(x_BND, mask)
        return self._split(self.norm(x_BND), task_BLD.shape[1], {k: v.shape[2] for k, v in groups.items()})

    def _split(self, x_BND: Tensor, n_task: int, counts: Mapping[str, int]) -> Outputs:
        per_step = sum(counts.values()) + 1
        steps_BWND = x_BND[:, n_task:].reshape(len(x_BND), -1, per_step, x_BND.shape[-1])
        parts = torch.split(steps_BWND, [*counts.values(), 1], dim=2)
        return Outputs(x_BND[:, :n_task], dict(zip(counts, parts[:-1], strict=True)), parts[-1].squeeze(2))


def attention_mask(keys_BN: Tensor, n_task: int, n_steps: int) -> Tensor:
    """Return (B, 1, N, N): who (third) may look at whom (fourth); the `n_task` tokens come first.

    The instruction looks at itself. A step's observation looks at the instruction and at observations of
    its own and earlier steps. A readout, the last token of its step, looks at all that, and at its own and
    earlier readouts, which nothing else attends to. Nothing attends to padding (`keys_BN` False).
    """
    n_tokens = keys_BN.shape[1]
    place = torch.arange(n_tokens, device=keys_BN.device) - n_task
    per_step = (n_tokens - n_task) // n_steps
    is_task = place < 0
    step = torch.where(is_task, -1, place // per_step)
    is_readout = ~is_task & (place % per_step == per_step - 1)
    may = step[None, :] <= step[:, None]
    may &= ~is_readout[None, :] | is_readout[:, None]
    mask = may & keys_BN[:, None, :]
    # A row without any key would be undefined; only padding has such rows, and they are not read.
    alone = ~mask.any(dim=-1, keepdim=True) & torch.eye(n_tokens, dtype=torch.bool, device=mask.device)
    return (mask | alone)[:, None]


def _positions(*shape: int) -> nn.Parameter:
    return nn.Parameter(torch.randn(shape) * POSITION_STD)


class OctoNetwork(nn.Module):
    """The parts that the original trains; the text encoder, which it never trains, is beside it."""

    def __init__(self, transformer: TransformerSizes, head: HeadSizes) -> None:
        super().__init__()
        self.transformer = OctoTransformer(transformer)
        self.head = DiffusionHead(head)
