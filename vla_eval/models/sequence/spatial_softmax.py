"""Where each map is strongest, and how strong: a spatial softmax over normalised maps.

Written out with its gradient, since these maps are most of what a training step moves through memory:
autograd keeps and passes over twice as many of them.
"""

from typing import Any  # torch's context of a function is untyped

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

LEAST_VARIANCE = 1e-5  # as torch's instance_norm


def spatial_softmax(maps: Tensor, sharpness: Tensor, places: Tensor) -> Tensor:
    """Return (N, maps, 3): x, y, and the map's own value there, each weighted by the softmax.

    Args:
        maps: (N, maps, P), the value of each map at each of P places.
        sharpness: (maps,) by which normalised maps are multiplied before the softmax.
        places: (P, 2) x and y.
    """
    found: Tensor = _SpatialSoftmax.apply(maps, sharpness, places)  # type: ignore[no-untyped-call]
    return found


class _SpatialSoftmax(torch.autograd.Function):
    """With a the maps less their mean μ and s the sharpness over their deviation: p = softmax(a · s).

    It returns the sum over all places of p · (x, y, a + μ).
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
