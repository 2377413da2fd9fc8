"""Names of weights: those of `IPEC-COMMUNITY/spatialvla-4b-224-pt` to ours; layouts are equal."""

from collections.abc import Mapping

from torch import Tensor

# Beginnings of names, (original, ours); a name that begins with none of them is kept.
BEGINNINGS: tuple[tuple[str, str], ...] = (
    ("vision_tower.vision_model.", "vision."),
    ("language_model.lm_head.", "lm_head."),
    ("language_model.model.", "llm."),
    ("multi_modal_projector.linear.", "projector."),
    ("vision_zoe_model.", "depth.zoe."),
)
EMBEDDINGS, HEAD = "language_model.model.embed_tokens.weight", "language_model.lm_head.weight"


def to_ours(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the original's tensors under our names; an unknown name stays, and the loader refuses it."""
    return {_renamed(name, BEGINNINGS): tensor for name, tensor in weights.items()}


def _renamed(name: str, pairs: tuple[tuple[str, str], ...]) -> str:
    for old, new in pairs:
        if name.startswith(old):
            return new + name.removeprefix(old)
    return name
