"""Read an original Octo checkpoint, to make a LeRobot checkpoint of it. Downloads nothing."""

from pathlib import Path
from typing import Any  # lerobot is untyped

from torch import Tensor

from vla_eval.errors import CheckpointError
from vla_eval.features import ACTION_KEY, IMAGE_SHAPE
from vla_eval.models.families import bases
from vla_eval.models.octo.configuration_octo import MikasaOctoConfig
from vla_eval.models.octo.conversion_options import OctoOptions
from vla_eval.models.octo.flax_names import from_flax
from vla_eval.models.octo.original import read_parameters, read_statistics
from vla_eval.models.octo.processor_octo import make_mikasa_octo_pre_post_processors
from vla_eval.models.shared.original import Original, stated_gripper, with_features


def read_original(source: Path, options: OctoOptions) -> Original:
    """Read the original's folder: parameters and `dataset_statistics.json`."""
    of_size = {} if options.size is None else bases()[f"octo_{options.size}"].fields
    named = {} if options.tokenizer is None else {"tokenizer_name": options.tokenizer}
    encoding = stated_gripper(source, options.gripper)
    config = octo_config({**of_size, **options.fields, **named, "gripper_encoding": encoding})
    statistics = read_statistics(source if source.is_dir() else source.parent, dataset=options.dataset)
    return Original(
        config=config,
        weights=lambda policy: _with_shared(policy, from_flax(read_parameters(source))),
        make_processors=lambda: make_mikasa_octo_pre_post_processors(config, {ACTION_KEY: dict(statistics)}),
    )


def octo_config(fields: dict[str, Any]) -> MikasaOctoConfig:
    """Return the configuration of an Octo that sees our cameras and gives our actions."""
    height, width, _ = IMAGE_SHAPE
    try:
        config = MikasaOctoConfig(device="cpu", push_to_hub=False, **fields)
    except (TypeError, ValueError) as exc:
        raise CheckpointError(f"not a configuration of Octo: {exc}.") from exc
    return with_features(config, dict.fromkeys(config.cameras.values(), (height, width)))


def _with_shared(policy: Any, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Leave out embeddings that newer versions of transformers do not have under a second name."""
    wanted = policy.state_dict()
    return {key: x for key, x in weights.items() if key in wanted or not key.endswith("embed_tokens.weight")}
