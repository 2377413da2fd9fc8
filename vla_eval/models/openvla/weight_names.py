"""Names and layouts of weights: those of `openvla/openvla-7b` and OFT to ours, exactly.

The original's vision encoders are timm models: one matrix for query, key and value, positions without a row
for the class token. What it has and never uses (last blocks, final norms, SigLIP's pooling) is left out.
"""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from vla_eval.models.openvla.sizes import NetworkSizes

DINO, SIGLIP = "vision_backbone.featurizer.", "vision_backbone.fused_featurizer."
OUR_DINO, OUR_SIGLIP = "vision.dino.", "vision.siglip."
# Ends of names that differ, (original, ours); the rest of a name is the same.
DINO_NAMES: tuple[tuple[str, str], ...] = (
    ("cls_token", "embeddings.cls_token"),
    ("reg_token", "embeddings.register_tokens"),
    ("patch_embed.proj.", "embeddings.patch_embeddings.projection."),
    ("blocks.", "encoder.layer."),
    (".attn.proj.", ".attention.output.dense."),
    (".ls1.scale_factor", ".layer_scale1.lambda1"),
    (".ls2.scale_factor", ".layer_scale2.lambda1"),
)
SIGLIP_NAMES: tuple[tuple[str, str], ...] = (
    ("patch_embed.proj.", "embeddings.patch_embedding."),
    ("blocks.", "encoder.layers."),
    (".attn.proj.", ".self_attn.out_proj."),
    (".norm1.", ".layer_norm1."),
    (".norm2.", ".layer_norm2."),
)
FUSED = ".attn.qkv."
DINO_SPLIT = tuple(f".attention.attention.{name}." for name in ("query", "key", "value"))
SIGLIP_SPLIT = tuple(f".self_attn.{name}_proj." for name in ("q", "k", "v"))
DINO_POSITIONS, SIGLIP_POSITIONS = "embeddings.position_embeddings", "embeddings.position_embedding.weight"
POSITIONS = "pos_embed"
TOP = (("language_model.", "llm."),)  # projector, action_head and proprio_projector have the same names


def unused(name: str, sizes: NetworkSizes) -> bool:
    """Whether a tensor of the original does not influence anything it computes."""
    if name.startswith(SIGLIP):
        rest, depth = name.removeprefix(SIGLIP), sizes.siglip_depth
    elif name.startswith(DINO):
        rest, depth = name.removeprefix(DINO), sizes.dino_depth
    else:
        return False
    return rest.startswith((f"blocks.{depth - 1}.", "norm.", "attn_pool."))


def to_ours(weights: Mapping[str, Tensor], sizes: NetworkSizes) -> dict[str, Tensor]:
    """Return tensors in our names and layouts; an unknown name stays as it is, for the loader to refuse."""
    ours: dict[str, Tensor] = {}
    for name, tensor in weights.items():
        if unused(name, sizes):
            continue
        if name.startswith(SIGLIP):
            ours.update(_encoder(name.removeprefix(SIGLIP), tensor, OUR_SIGLIP, SIGLIP_NAMES, SIGLIP_SPLIT))
        elif name.startswith(DINO):
            ours.update(_encoder(name.removeprefix(DINO), tensor, OUR_DINO, DINO_NAMES, DINO_SPLIT))
        else:
            ours[_replaced(name, TOP)] = tensor
    return ours


def _encoder(
    rest: str, tensor: Tensor, prefix: str, names: Iterable[tuple[str, str]], split: tuple[str, ...]
) -> dict[str, Tensor]:
    if rest == POSITIONS and prefix == OUR_DINO:
        no_class = torch.zeros_like(tensor[:, :1])
        return {prefix + DINO_POSITIONS: torch.cat([no_class, tensor], dim=1)}
    if rest == POSITIONS:
        return {prefix + SIGLIP_POSITIONS: tensor[0]}
    renamed = _replaced(rest, names)
    if FUSED in rest:
        parts = zip(split, tensor.chunk(3), strict=True)
        return {prefix + renamed.replace(FUSED, name): part.clone() for name, part in parts}
    return {prefix + renamed: tensor}


def _replaced(name: str, pairs: Iterable[tuple[str, str]]) -> str:
    for old, new in pairs:
        if name.startswith(old) or (old.startswith(".") and old in name) or name == old:
            name = name.replace(old, new, 1)
    return name
