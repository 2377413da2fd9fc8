"""Our weights of OpenVLA and SpatialVLA under the originals' names: what gradients are compared by."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from vla_eval.models.openvla.weight_names import (
    DINO,
    DINO_NAMES,
    DINO_POSITIONS,
    DINO_SPLIT,
    FUSED,
    OUR_DINO,
    OUR_SIGLIP,
    POSITIONS,
    SIGLIP,
    SIGLIP_NAMES,
    SIGLIP_POSITIONS,
    SIGLIP_SPLIT,
    TOP,
    _replaced,
)
from vla_eval.models.spatialvla.conversion import BEGINNINGS


def openvla_names(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return our tensors under the original's names and in its layouts; what it never uses is not there."""
    original: dict[str, Tensor] = {}
    for name, tensor in weights.items():
        if name.startswith(OUR_SIGLIP):
            encoder = (OUR_SIGLIP, SIGLIP, SIGLIP_NAMES, SIGLIP_SPLIT)
        elif name.startswith(OUR_DINO):
            encoder = (OUR_DINO, DINO, DINO_NAMES, DINO_SPLIT)
        else:
            original[_replaced(name, _back(TOP))] = tensor
            continue
        ours, theirs, names, split = encoder
        rest = name.removeprefix(ours)
        if rest == DINO_POSITIONS:
            # The row of the class token is not always zero after training; it belongs to that token.
            original[theirs + POSITIONS] = tensor[:, 1:]
            original[f"{theirs}cls_token"] = weights[f"{ours}embeddings.cls_token"] + tensor[:, :1]
        elif rest == SIGLIP_POSITIONS:
            original[theirs + POSITIONS] = tensor[None]
        elif split[0] in rest:
            parts = [weights[ours + rest.replace(split[0], part)] for part in split]
            fused = _replaced(rest.replace(split[0], FUSED), _back(names))
            original[theirs + fused] = torch.cat(parts)
        elif not any(part in rest for part in split):
            original.setdefault(theirs + _replaced(rest, _back(names)), tensor)
    return original


def spatialvla_names(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return our tensors under the original's names."""
    original = {}
    for name, tensor in weights.items():
        theirs, ours = next((pair for pair in BEGINNINGS if name.startswith(pair[1])), ("", ""))
        original[theirs + name.removeprefix(ours)] = tensor
    return original


def _back(pairs: Iterable[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    return tuple((new, old) for old, new in pairs)
