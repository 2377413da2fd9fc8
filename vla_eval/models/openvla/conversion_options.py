"""Options for converting a published OpenVLA, or what the OFT scripts have saved. Without torch."""

from dataclasses import dataclass, field
from typing import get_args

from vla_eval.features import CAMERA_KEYS
from vla_eval.models.openvla.sizes import Head
from vla_eval.models.shared.options import YES_NO, gripper_option, option


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenVLAOptions:
    """What the files do not say; flags explain themselves."""

    head: str = option("tokens", "--head", choices=get_args(Head), help="tokens: a plain OpenVLA")
    chunk_size: int = option(1, "--chunk", type=int, metavar="K", help="actions of a chunk (1)")
    unnorm_key: str | None = option(
        None, "--unnorm-key", metavar="NAME", help="whose statistics, where there are several"
    )
    image_augmentation: bool | None = option(
        None, "--image-aug", values=YES_NO, help="trained with augmentation (as named)"
    )
    proprio: int = option(0, "--proprio", type=int, metavar="N", help="numbers of proprioception (0)")
    pictures: tuple[str, ...] = option(
        tuple(CAMERA_KEYS.values()),
        "--images",
        former="--pictures",
        nargs="+",
        metavar="FIELD",
        help="fields of the images, in order",
    )
    gripper: str | None = gripper_option()
    allow_pickled: bool = option(
        False, "--allow-pickled", action="store_true", help="read heads that are pickled tensors"
    )
    camera_px: int = 128
    sizes: dict[str, int] = field(default_factory=dict)
    dtype: str = "bfloat16"
