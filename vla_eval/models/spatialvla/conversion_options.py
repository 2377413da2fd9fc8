"""Options for converting a published SpatialVLA. Without torch."""

from dataclasses import dataclass, field

from vla_eval.features import CAMERA_KEYS
from vla_eval.models.shared.options import option


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialVLAOptions:
    """What the files do not say; flags explain themselves.

    Attributes:
        unnorm_key: None: the only statistics that there are, or none at all.
        head: None: as the files say, and an error if they contradict each other.
        cameras: fields of the images that the policy expects; `pictures` says which of them are read.
        camera_px: edge of the images as a camera gives them.
        sizes: sizes that differ from the published ones.
        dtype: of the result.
    """

    unnorm_key: str | None = option(
        None, "--unnorm-key", metavar="NAME", help="whose statistics, where there are several"
    )
    pictures: tuple[str, ...] = option(
        (CAMERA_KEYS["base_camera"],),
        "--images",
        former="--pictures",
        nargs="+",
        metavar="FIELD",
        help="images that are read (the base's)",
    )
    head: str | None = option(
        None,
        "--head",
        choices=("tied", "own"),
        help="Gemma's output matrix: its input's, or its own (as told)",
    )
    cameras: tuple[str, ...] = tuple(CAMERA_KEYS.values())
    camera_px: int = 128
    sizes: dict[str, int] = field(default_factory=dict)
    dtype: str = "bfloat16"
