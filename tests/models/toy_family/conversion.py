"""The converter of the toy: published weights are to be scaled."""

from dataclasses import dataclass
from pathlib import Path

from toy_family.configuration_toy import MikasaToyConfig

from vla_eval.features import CAMERA_KEYS
from vla_eval.models.shared.options import option
from vla_eval.models.shared.original import Original, read_safetensors, with_features
from vla_eval.models.shared.plain_processors import make_plain_processors


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyOptions:
    scale: float = option(1.0, "--scale", type=float, help="of the weights")


def read_original(source: Path, options: ToyOptions) -> Original:
    config = with_features(
        MikasaToyConfig(device="cpu", push_to_hub=False),
        dict.fromkeys(CAMERA_KEYS.values(), (8, 8)),
        state=3,
    )
    return Original(
        config=config,
        weights=lambda _: {name: x * options.scale for name, x in read_safetensors(source).items()},
        make_processors=lambda: make_plain_processors(config),
    )
