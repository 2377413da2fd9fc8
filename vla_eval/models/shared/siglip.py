"""SigLIP's vision encoder from transformers, as the ported policies use it. Knows no policy."""

from typing import Any  # transformers is untyped here

from transformers import SiglipVisionConfig, SiglipVisionModel

from vla_eval.models.shared.network_sizes import VisionSizes

LAYER_NORM_EPS = 1e-6


def siglip(sizes: VisionSizes, *, n_blocks: int, activation: str) -> Any:
    """Return the encoder of that depth with random weights, without its pooling head."""
    model: Any = SiglipVisionModel(
        SiglipVisionConfig(
            hidden_size=sizes.siglip_width,
            intermediate_size=sizes.siglip_mlp,
            num_hidden_layers=n_blocks,
            num_attention_heads=sizes.siglip_heads,
            hidden_act=activation,
            layer_norm_eps=LAYER_NORM_EPS,
            image_size=sizes.image_px,
            patch_size=sizes.patch_px,
            vision_use_head=False,
            attn_implementation="sdpa",
        )
    )
    # In some versions of transformers the tower is wrapped: parameters have the same names in all.
    return getattr(model, "vision_model", model)
