"""The fused vision encoder, DINOv2 with registers and SigLIP, and the projector into Llama's width.

Legend: B samples, C cameras, P patches of an image, D channels.

Features are those of the second-to-last block, without the final norm and without class and register
tokens. Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
prismatic/extern/hf/modeling_prismatic.py#L67-L262.
"""

from typing import Any  # transformers is untyped here

import torch
from torch import Tensor, nn
from torch.nn import functional
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

from vla_eval.models.openvla.sizes import NetworkSizes
from vla_eval.models.shared.precision import in_float32
from vla_eval.models.shared.siglip import LAYER_NORM_EPS, siglip

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # what DINOv2 was trained with
SIGLIP_MEAN, SIGLIP_STD = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)
GELU = "gelu"  # the exact one; transformers' SigLIP would take the tanh approximation, the original does not
DINO_MLP_RATIO, PROJECTOR_RATIO = 4, 4


class FusedVision(nn.Module):
    """Images to features of patches."""

    mean: Tensor
    std: Tensor

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.n_prefix_tokens = 1 + sizes.dino_registers
        self.dino = _dino(sizes)
        self.siglip = siglip(sizes, n_blocks=sizes.siglip_depth - 1, activation=GELU)
        self.siglip.post_layernorm = nn.Identity()
        means = torch.tensor([IMAGENET_MEAN, SIGLIP_MEAN], dtype=torch.float32).reshape(2, 1, 3, 1, 1)
        stds = torch.tensor([IMAGENET_STD, SIGLIP_STD], dtype=torch.float32).reshape(2, 1, 3, 1, 1)
        self.register_buffer("mean", means, persistent=False)
        self.register_buffer("std", stds, persistent=False)

    @in_float32
    def normalised(self, images: Tensor) -> Tensor:
        """Return (2, N, 3, H, W): what DINOv2 sees and what SigLIP sees of (N, 3, H, W) in [0, 1]."""
        return (images - self.mean) / self.std

    def forward(self, images: Tensor) -> Tensor:
        """Return (B, C · P, D) of images (B, C, 3, H, W) in [0, 1]: patches, one image after the other."""
        for_dino, for_siglip = self.normalised(images.flatten(0, 1)).to(self.dino.dtype).unbind()
        seen = self.dino(for_dino).last_hidden_state[:, self.n_prefix_tokens :]
        features = torch.cat([seen, self.siglip(for_siglip).last_hidden_state], dim=-1)
        return features.reshape(len(images), -1, features.shape[-1])


class Projector(nn.Module):
    """Features of patches (…, vision) to tokens (…, llm)."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        between = PROJECTOR_RATIO * sizes.vision_width
        self.fc1 = nn.Linear(sizes.vision_width, between)
        self.fc2 = nn.Linear(between, sizes.llm_width)
        self.fc3 = nn.Linear(sizes.llm_width, sizes.llm_width)

    def forward(self, features: Tensor) -> Tensor:
        """Return the tokens."""
        projected: Tensor = self.fc3(functional.gelu(self.fc2(functional.gelu(self.fc1(features)))))
        return projected


def _dino(sizes: NetworkSizes) -> Any:
    model: Any = Dinov2WithRegistersModel(
        Dinov2WithRegistersConfig(
            hidden_size=sizes.dino_width,
            num_hidden_layers=sizes.dino_depth - 1,
            num_attention_heads=sizes.dino_heads,
            mlp_ratio=DINO_MLP_RATIO,
            hidden_act=GELU,
            layer_norm_eps=LAYER_NORM_EPS,
            image_size=sizes.image_px,
            patch_size=sizes.patch_px,
            num_register_tokens=sizes.dino_registers,
            attn_implementation="sdpa",
        )
    )
    model.layernorm = nn.Identity()
    del model.embeddings.mask_token  # only for pre-training; the original has none
    return model
