"""Sizes of a network as a recipe changes them: known names, possible values. Knows nothing of torch."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any  # lerobot's configurations

from vla_eval.errors import RecipeError, check_names


@dataclass(frozen=True, slots=True, kw_only=True)
class VisionSizes:
    """Sizes of images and of SigLIP (so400m/14 as published), which OpenVLA and SpatialVLA both have."""

    image_px: int = 224
    patch_px: int = 14
    siglip_width: int = 1152
    siglip_depth: int = 27
    siglip_heads: int = 16
    siglip_mlp: int = 4304

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if getattr(self, field.name) < 0:
                raise RecipeError(f"sizes.{field.name} is {getattr(self, field.name)}, expected ≥ 0.")
        if self.image_px % self.patch_px:
            raise RecipeError(f"sizes.image_px is {self.image_px}, expected a multiple of {self.patch_px}.")

    @property
    def n_patches(self) -> int:
        """Patches of one image."""
        return (self.image_px // self.patch_px) ** 2


def sizes_from[S](sizes: type[S], config: Any, **others: Any) -> S:
    """Return sizes that a configuration has under the same names, and others."""
    names = {field.name for field in dataclasses.fields(sizes)} - others.keys()  # type: ignore[arg-type]
    return sizes(**{name: getattr(config, name) for name in names}, **others)


def with_changes[T: VisionSizes](published: type[T], changes: Mapping[str, int]) -> T:
    """Return the published sizes, which are the defaults, with some of them changed by name."""
    known = [field.name for field in dataclasses.fields(published)]
    check_names("size", changes, known, where="finetune.policy.sizes")
    return published(**changes)
