"""Options for converting a published SpatialVLA. Without torch."""

from dataclasses import dataclass, field

from vla_eval.features import CAMERA_KEYS
from vla_eval.models.shared.options import option


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialVLAOptions:
    """What the files do not say; flags explain themselves."""

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
