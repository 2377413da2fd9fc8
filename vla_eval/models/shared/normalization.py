"""Normalise vectors dimension by dimension, and back. Knows torch, nothing of lerobot or of policies.

Statistics are never missing without an error: what is to be normalised must have them, of the right size
and finite. Statistics from a training here are never of a dimension that does not vary
(`data.exact_statistics`). In those of earlier and of converted checkpoints it is treated as the originals do:

- `mean_std` (Octo) divides by the deviation plus epsilon, whatever it is: the one value becomes 0. Source:
  https://github.com/octo-models/octo/blob/241fb3514b7c40957a86d869fecb7c7fc353f540/octo/data/utils/data_utils.py#L243
- `q01_q99` (OpenVLA-OFT, SpatialVLA) makes it 0 where the extremes are equal. Equal quantiles are not enough:
  a dimension that moves once in a hundred frames is -1 at rest and +1 where it moves. Source:
  https://github.com/SpatialVLA/SpatialVLA/blob/e48075326a92116adaaf1232cf01471f15f09a73/data/utils/data_utils.py#L81
  and openvla-oft, prismatic/vla/datasets/rlds/utils/data_utils.py (commit 213c5ff). There the rule also holds
  for what the mask leaves alone; here it does not, or a gripper that is always open would be closed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from vla_eval.errors import CheckpointError, RecipeError, did_you_mean
from vla_eval.models.shared.precision import in_float32
from vla_eval.models.shared.step_names import EXTREMES, STATISTICS, NormalizationKind

EPSILON = 1e-8  # added to what is divided by, in all of the originals


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalization:
    """How one field is normalised."""

    # `mean_std`: (x - mean) / std. `q01_q99`: the range between these quantiles becomes [-1, 1].
    kind: NormalizationKind
    mask: tuple[bool, ...]  # for each dimension whether it is normalised; others are left as they are
    clip: bool = False  # cut to [-1, 1] after normalising; only with `q01_q99`
    clip_unmasked: bool = False  # cut dimensions that are left as they are, too

    def __post_init__(self) -> None:
        if self.kind not in STATISTICS:
            raise RecipeError(
                f"normalization.kind is '{self.kind}'.{did_you_mean(self.kind, STATISTICS)} Known: "
                f"{', '.join(STATISTICS)}."
            )
        if not self.mask:
            raise RecipeError("normalization.mask is empty, expected one value per dimension.")
        if self.clip and self.kind != "q01_q99":
            raise RecipeError("normalization.clip is for q01_q99: mean_std has no range to cut to.")
        if self.clip_unmasked and not self.clip:
            raise RecipeError("normalization.clip_unmasked is for what clip leaves out; expected clip, too.")


class Normalizer:
    """A `Normalization` with its statistics: name -> one number per dimension."""

    def __init__(self, spec: Normalization, statistics: Mapping[str, Any], *, where: str) -> None:
        self.spec = spec
        self._where = where
        names = [*STATISTICS[spec.kind], *(name for name in EXTREMES[spec.kind] if name in statistics)]
        self._statistics = {
            name: _checked(name, statistics, n_dims=len(spec.mask), where=where) for name in names
        }

    @property
    def statistics(self) -> dict[str, Tensor]:
        """What was used, as float32 of shape (D,) by name."""
        return {name: values.clone() for name, values in self._statistics.items()}

    @in_float32
    def normalize(self, values: Tensor) -> Tensor:
        """Return values (…, D), normalised; for training targets and for the state."""
        mask, first, second = self._for(values)
        if self.spec.kind == "mean_std":
            return torch.where(mask, (values - first) / (second + EPSILON), values)
        scaled = 2 * (values - first) / (second - first + EPSILON) - 1
        if self.spec.clip:
            scaled = scaled.clamp(-1, 1)
        scaled = torch.where(self._is_constant().to(values.device), 0.0, scaled)
        return torch.where(mask, scaled, values.clamp(-1, 1) if self.spec.clip_unmasked else values)

    @in_float32
    def unnormalize(self, values: Tensor) -> Tensor:
        """Return normalised values (…, D) in the unit of the data; for predicted actions."""
        mask, first, second = self._for(values)
        if self.spec.kind == "mean_std":
            return torch.where(mask, values * second + first, values)
        return torch.where(mask, 0.5 * (values + 1) * (second - first) + first, values)

    def _is_constant(self) -> Tensor:
        """Return (D,) bool; checkpoints from before the extremes were kept have quantiles alone."""
        low, high = EXTREMES["q01_q99"]
        if low in self._statistics and high in self._statistics:
            return self._statistics[low] == self._statistics[high]
        return self._statistics["q01"] == self._statistics["q99"]

    def _for(self, values: Tensor) -> "_Parts":
        if values.shape[-1:] != (len(self.spec.mask),):
            raise CheckpointError(
                f"{self._where}: expected {len(self.spec.mask)} dimensions, found shape "
                f"{tuple(values.shape)}."
            )
        first, second = (
            self._statistics[name].to(values.device, values.dtype) for name in STATISTICS[self.spec.kind]
        )
        return _Parts(torch.tensor(self.spec.mask, device=values.device), first, second)


class _Parts(NamedTuple):
    """Mask and the two statistics, (D,), of the type and device of what is normalised."""

    mask: Tensor
    first: Tensor
    second: Tensor


def mask_all_but(n_dims: int, *, left_alone: tuple[int, ...] = ()) -> tuple[bool, ...]:
    """Return a mask of so many dimensions, False at the given ones; -1 is the last."""
    excluded = {index % n_dims for index in left_alone}
    return tuple(index not in excluded for index in range(n_dims))


def _checked(name: str, statistics: Mapping[str, Any], *, n_dims: int, where: str) -> Tensor:
    if name not in statistics:
        raise CheckpointError(
            f"{where}: there is no statistic '{name}' (found: {', '.join(statistics) or 'none'}). Without it "
            f"the numbers would pass unchanged. Fine-tune on a dataset that has it, or fetch the complete "
            f"checkpoint."
        )
    values = torch.as_tensor(statistics[name], dtype=torch.float32).cpu().reshape(-1)
    if len(values) != n_dims:
        raise CheckpointError(f"{where}: '{name}' has {len(values)} dimensions, expected {n_dims}.")
    if not torch.isfinite(values).all():
        raise CheckpointError(f"{where}: '{name}' is not finite: {values.tolist()}.")
    return values
