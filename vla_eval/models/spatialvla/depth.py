"""The frozen depth model: transformers' ZoeDepth, and the form in which the original gives it images.

Images are padded by mirroring, resized to the model's size, and the depth is resized and cut back.
ZoeDepth has a head for rooms and one for streets and takes **one for a whole batch**, by a vote; here each
image gets the head that it votes for itself, so that its depth does not depend on what is beside it.
"""

from typing import Any  # transformers is untyped here

import torch
from torch import Tensor, nn
from torch.nn import functional
from transformers import BeitConfig, ZoeDepthConfig, ZoeDepthForDepthEstimation

from vla_eval.models.shared.precision import in_float32
from vla_eval.models.spatialvla.sizes import NetworkSizes

PAD_PX = 31
"""Pixels that are mirrored at each edge, whatever the image's size. It is ZoeDepth's own padding,
√(size / 2) · 3, at 224. Source: transformers 5.5.4, models/zoedepth/image_processing_zoedepth.py."""
MEAN = STD = 0.5  # of ZoeDepth's normalisation, per colour
NECK_SHARES = (4, 2, 1, 1)  # of `depth_neck`: 256, 512, 1024, 1024 as published
ROOM_M, STREET_M = 10.0, 80.0  # farthest depth of either head
NEAREST_M = 1e-3
HEADS = {"nyu": ROOM_M, "kitti": STREET_M}
# transformers fixes the router's output to 128 numbers, whatever the configuration says.
ROUTER = {
    "num_patch_transformer_layers": 4,
    "patch_transformer_hidden_size": 128,
    "patch_transformer_intermediate_size": 1024,
    "patch_transformer_num_attention_heads": 4,
}


class DepthModel(nn.Module):
    """Images to metres. Frozen, and never in training mode: its vision encoder would drop paths at random."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.size_px = sizes.depth_px
        self.zoe = zoe_depth(sizes)
        self.requires_grad_(False)
        self.train(False)

    def train(self, mode: bool = True) -> "DepthModel":
        """Stay as it is."""
        super().train(False)
        return self

    @torch.no_grad()
    def forward(self, images: Tensor) -> Tensor:
        """Return depth (N, depth_px, depth_px), float32, of images (N, 3, H, W) in [0, 1], padded."""
        shown = shown_images(images, self.size_px).to(self.zoe.dtype)
        answer = self.zoe(shown)
        votes = answer.domain_logits.argmax(dim=-1)
        depth: Tensor = answer.predicted_depth
        if int(votes.min()) != int(votes.max()):
            depth = depth.clone()
            for vote in votes.unique():
                depth[votes == vote] = self.zoe(shown[votes == vote]).predicted_depth
        return depth.float()


@in_float32
def shown_images(images: Tensor, size_px: int) -> Tensor:
    """Return (N, 3, size, size), float32: what the depth model sees of images in [0, 1]."""
    padded = functional.pad(images, (PAD_PX,) * 4, mode="reflect")
    resized = functional.interpolate(padded, size=(size_px, size_px), mode="bicubic", align_corners=True)
    return (resized - MEAN) / STD


@in_float32
def cut_depth(depth: Tensor, image_px: int) -> Tensor:
    """Return the depth (N, image_px, image_px) of the images without their padding."""
    padded_px = image_px + 2 * PAD_PX
    resized = functional.interpolate(
        depth[:, None], size=(padded_px, padded_px), mode="bicubic", align_corners=True
    )
    return resized[:, 0, PAD_PX:-PAD_PX, PAD_PX:-PAD_PX]


def zoe_depth(sizes: NetworkSizes) -> Any:
    """Return transformers' ZoeDepth with random weights."""
    return ZoeDepthForDepthEstimation(zoe_config(sizes))


def zoe_config(sizes: NetworkSizes) -> Any:
    """Return transformers' configuration of it."""
    encoder = BeitConfig(
        image_size=sizes.depth_px,
        hidden_size=sizes.depth_width,
        num_hidden_layers=sizes.depth_layers,
        num_attention_heads=sizes.depth_heads,
        intermediate_size=sizes.depth_mlp,
        use_relative_position_bias=True,
        reshape_hidden_states=False,
        out_features=[f"stage{sizes.depth_layers * quarter // 4}" for quarter in (1, 2, 3, 4)],
    )
    return ZoeDepthConfig(
        backbone_config=encoder,
        neck_hidden_sizes=[sizes.depth_neck // share for share in NECK_SHARES],
        fusion_hidden_size=sizes.depth_fusion,
        bottleneck_features=sizes.depth_fusion,
        num_relative_features=sizes.depth_features,
        bin_embedding_dim=sizes.depth_embedding,
        bin_configurations=[
            {"name": name, "n_bins": sizes.depth_bins, "min_depth": NEAREST_M, "max_depth": farthest_m}
            for name, farthest_m in HEADS.items()
        ],
        **ROUTER,
    )
