"""Make a LeRobot checkpoint of an original Octo checkpoint, once. Downloads nothing."""

from pathlib import Path
from typing import Any, Literal  # lerobot is untyped

from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from vla_eval.checkpoints.conversion.octo_original import read_parameters, read_statistics
from vla_eval.checkpoints.conversion.writing import check_free, folder_when_whole, stated_gripper
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.loading import make_unfilled_policy
from vla_eval.checkpoints.processors import save_tokenizers
from vla_eval.errors import CheckpointError
from vla_eval.features import ACTION_KEY, ACTION_NAMES, IMAGE_SHAPE
from vla_eval.models.octo.configuration_octo import MikasaOctoConfig
from vla_eval.models.octo.flax_names import from_flax
from vla_eval.models.octo.processor_octo import make_mikasa_octo_pre_post_processors
from vla_eval.models.shared.weights import put_weights

Size = Literal["small", "base"]
SIZES: dict[Size, dict[str, Any]] = {
    "small": {},
    "base": {"width": 768, "layers": 12, "heads": 12, "mlp_width": 3072},
}
"""Source: octo/model/components/transformer.py of the original, `vit_s` and `vit_b`."""


def convert(
    source: Path,
    out: Path,
    *,
    fields: dict[str, Any],
    gripper: str | None,
    dataset: str | None = None,
    tokenizer: str | None = None,
) -> Path:
    """Write a LeRobot checkpoint; every parameter of the original is in it, and no other.

    Args:
        source: the original's folder: parameters and `dataset_statistics.json`.
        out: a folder that is not there yet.
        fields: of `MikasaOctoConfig`, such as `SIZES["small"]`.
        gripper: how the checkpoint's data encode it, see `steps.gripper`; None is refused: no file says it.
        dataset: which statistics, where there are several.
        tokenizer: folder of T5's tokenizer; None: the one that the configuration names, from the cache.

    Raises:
        CheckpointError: something lacks, is too much, or `out` exists.
    """
    check_free(out)
    named = {"tokenizer_name": tokenizer} if tokenizer is not None else {}
    encoding = stated_gripper(source, gripper)
    config = octo_config({**fields, **named, "gripper_encoding": encoding})
    statistics = read_statistics(source if source.is_dir() else source.parent, dataset=dataset)
    policy = make_unfilled_policy(config)
    put_weights(policy, _with_shared(policy, from_flax(read_parameters(source))), where=str(source))
    with no_foreign_code(config.type):
        before, after = make_mikasa_octo_pre_post_processors(config, {ACTION_KEY: dict(statistics)})
    with folder_when_whole(out) as partial:
        policy.save_pretrained(partial)
        before.save_pretrained(partial)
        after.save_pretrained(partial)
        save_tokenizers(before, partial)
    return out


def octo_config(fields: dict[str, Any]) -> MikasaOctoConfig:
    """Return the configuration of an Octo that sees our cameras and gives our actions.

    Raises:
        CheckpointError: a value is out of its range.
    """
    height, width, n_colors = IMAGE_SHAPE
    try:
        config = MikasaOctoConfig(device="cpu", push_to_hub=False, **fields)
    except (TypeError, ValueError) as exc:
        raise CheckpointError(f"not a configuration of Octo: {exc}.") from exc
    config.input_features = {
        field: PolicyFeature(type=FeatureType.VISUAL, shape=(n_colors, height, width))
        for field in config.cameras.values()
    }
    config.output_features = {ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES),))}
    return config


def _with_shared(policy: Any, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Leave out embeddings that newer versions of transformers do not have under a second name."""
    wanted = policy.state_dict()
    return {key: x for key, x in weights.items() if key in wanted or not key.endswith("embed_tokens.weight")}
