"""Normalise vectors dimension by dimension, and back. Knows torch, nothing of lerobot or of policies.

Statistics are never missing without an error: what is to be normalised must have them, of the right size
and finite. A dimension that does not vary is 0 after normalisation and its one value afterwards, so that
no rounding error is blown up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from vla_eval.errors import CheckpointError, RecipeError, did_you_mean
from vla_eval.policies.steps.precision import in_float32
from vla_eval.policies.steps.step_names import STATISTICS, NormalizationKind

EPSILON = 1e-8
"""Added to what is divided by. Source: octo, octo/data/utils/data_utils.py:243 at
https://github.com/octo-models/octo/blob/241fb3514b7c40957a86d869fecb7c7fc353f540/octo/data/utils/data_utils.py#L243
and openvla-oft, prismatic/vla/datasets/rlds/utils/data_utils.py:67 (commit 213c5ff)."""
CONSTANT_SPREAD = 1e-6
"""A dimension with less spread than this (in its own unit) does not vary: float32 has no more digits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalization:
    """How one field is normalised.

    Attributes:
        kind: `mean_std`: (x - mean) / std. `q01_q99`: the range between these quantiles becomes [-1, 1].
        mask: for each dimension whether it is normalised; others are left as they are.
        clip: cut to [-1, 1] after normalising; only with `q01_q99`.
    """

    kind: NormalizationKind
    mask: tuple[bool, ...]
    clip: bool = False

    def __post_init__(self) -> None:
        """Check what a type cannot say."""
        if self.kind not in STATISTICS:
            raise RecipeError(
                f"normalization.kind is '{self.kind}'.{did_you_mean(self.kind, STATISTICS)} Known: "
                f"{', '.join(STATISTICS)}."
            )
        if not self.mask:
            raise RecipeError("normalization.mask is empty, expected one value per dimension.")
        if self.clip and self.kind != "q01_q99":
            raise RecipeError("normalization.clip is for q01_q99: mean_std has no range to cut to.")


class _Affine(NamedTuple):
    """x -> (x - shift) / divisor, where varies; 0 where not; x where not masked.

    All of shape (D,) and of the type and device of what is normalised.
    """

    mask: Tensor
    varies: Tensor
    shift: Tensor
    divisor: Tensor
    factor: Tensor  # for the way back; the originals leave epsilon out of it for mean_std


class Normalizer:
    """A `Normalization` with its statistics.

    Args:
        spec: how.
        statistics: name -> one number per dimension.
        where: the field and where the statistics came from, for messages.

    Raises:
        CheckpointError: a statistic is missing, of another size, or not finite.
    """

    def __init__(self, spec: Normalization, statistics: Mapping[str, Any], *, where: str) -> None:
        self.spec = spec
        self._where = where
        self._first, self._second = (
            _checked(name, statistics, n_dims=len(spec.mask), where=where) for name in STATISTICS[spec.kind]
        )

    @property
    def statistics(self) -> dict[str, Tensor]:
        """What was used, as float32 of shape (D,) by name."""
        first, second = STATISTICS[self.spec.kind]
        return {first: self._first.clone(), second: self._second.clone()}

    @in_float32
    def normalize(self, values: Tensor) -> Tensor:
        """Return values (…, D), normalised; for training targets and for the state."""
        affine = self._affine(values)
        scaled = torch.where(affine.varies, (values - affine.shift) / affine.divisor, 0.0)
        if self.spec.clip:
            scaled = scaled.clamp(-1, 1)
        return torch.where(affine.mask, scaled, values)

    @in_float32
    def unnormalize(self, values: Tensor) -> Tensor:
        """Return normalised values (…, D) in the unit of the data; for predicted actions."""
        affine = self._affine(values)
        scaled = torch.where(affine.varies, values * affine.factor, 0.0) + affine.shift
        return torch.where(affine.mask, scaled, values)

    def _affine(self, values: Tensor) -> _Affine:
        if values.shape[-1:] != (len(self.spec.mask),):
            raise CheckpointError(
                f"{self._where}: expected {len(self.spec.mask)} dimensions, found shape "
                f"{tuple(values.shape)}."
            )
        first, second = (
            statistic.to(values.device, values.dtype) for statistic in (self._first, self._second)
        )
        mask = torch.tensor(self.spec.mask, device=values.device)
        if self.spec.kind == "mean_std":
            return _Affine(mask, second > CONSTANT_SPREAD, first, second + EPSILON, second)
        half = (second - first + EPSILON) / 2
        return _Affine(mask, second - first > CONSTANT_SPREAD, (first + second) / 2, half, half)


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
