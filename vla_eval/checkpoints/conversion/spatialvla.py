"""Make a LeRobot checkpoint of a published SpatialVLA: safetensors, `processor_config.json` and tokenizer.

No code of the checkpoint is run. Names of weights come from the golden files and, for ZoeDepth, from
transformers; the released weights were not seen (docs/spatialvla.md), so what differs is an error. What the
JSON files look like: those of `spatialvla-4b-mix-224-pt`, kept at https://github.com/tannq-jo/pg-vla/tree/
d8d7cb42abebe2f4f785f75ca53b0f6933e33588/exp/models.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal  # JSON and lerobot

import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from vla_eval.checkpoints.conversion.spatialvla_described import GRID_PARTS, PROCESSOR_FILE, check_described
from vla_eval.checkpoints.conversion.writing import (
    Statistics,
    check_free,
    check_mask,
    chosen_statistics,
    read_safetensors,
    write_checkpoint,
)
from vla_eval.checkpoints.files import CONFIG_FILE, read_json
from vla_eval.checkpoints.loading import make_unfilled_policy
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.features import ACTION_KEY, ACTION_NAMES, CAMERA_KEYS
from vla_eval.models.shared.weights import put_weights
from vla_eval.models.spatialvla.action_grid import AXES
from vla_eval.models.spatialvla.configuration_spatialvla import MikasaSpatialVLAConfig
from vla_eval.models.spatialvla.processor_spatialvla import make_mikasa_spatialvla_pre_post_processors
from vla_eval.models.spatialvla.prompt import finished, prompt_text
from vla_eval.models.spatialvla.sizes import Attention, NetworkSizes
from vla_eval.models.spatialvla.weight_names import EMBEDDINGS, HEAD, to_ours

Head = Literal["tied", "own"]
ORIGINALS_INFERENCE: Attention = "bidirectional"
"""What the prefix attends to when the original predicts, however it was trained: unless flash attention is
asked for, its mask hides no token of the prompt where there are no labels. Source: https://github.com/
SpatialVLA/SpatialVLA/blob/e48075326a92116adaaf1232cf01471f15f09a73/model/modeling_spatialvla.py#L258-L306."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """What the files do not say of themselves.

    Attributes:
        unnorm_key: whose statistics are used; None: the only ones there are, or none at all.
        cameras: fields of the images that the policy expects; `pictures` says which of them are read.
        pictures: see `MikasaSpatialVLAConfig`.
        camera_px: edge of the images as a camera gives them.
        head: whether Gemma's output matrix is that of its input (`tied`) or a tensor of its own; None: as the
            files say, and an error if they contradict each other.
        sizes: sizes that differ from the published ones.
        dtype: of the result.
    """

    unnorm_key: str | None = None
    cameras: tuple[str, ...] = tuple(CAMERA_KEYS.values())
    pictures: tuple[str, ...] = (CAMERA_KEYS["base_camera"],)
    camera_px: int = 128
    head: Head | None = None
    sizes: dict[str, int] = field(default_factory=dict)
    dtype: str = "bfloat16"


def convert_spatialvla(source: Path, out: Path, options: ConvertOptions) -> Path:
    """Write the LeRobot checkpoint `out`; return it.

    Args:
        source: folder with `config.json`, `processor_config.json`, safetensors and tokenizer.
        out: a folder that is not there yet.
        options: see there.

    Raises:
        CheckpointError: something is missing, of another form, or not what the options say.
    """
    check_free(out)
    described, processor = read_json(source / CONFIG_FILE), read_json(source / PROCESSOR_FILE)
    weights = read_safetensors(source)
    has_own_head = _settle_head(source, described, weights, options.head)
    config = _config(source, processor, options, has_own_head=has_own_head)
    check_described(source, config.network_sizes())
    policy = make_unfilled_policy(config)
    named = {f"network.{name}": value for name, value in to_ours(weights).items()}
    put_weights(policy, named, where=str(source), cast=True)
    statistics = read_statistics(source, processor, config, options.unnorm_key)
    return write_checkpoint(
        source,
        out,
        policy,
        lambda: make_mikasa_spatialvla_pre_post_processors(config, statistics),
        check_tokenizer=lambda tokenizer: _check_tokenizer(source, tokenizer, config.network_sizes()),
    )


def read_statistics(
    source: Path, processor: Mapping[str, Any], config: MikasaSpatialVLAConfig, unnorm_key: str | None
) -> Statistics | None:
    """Return field -> statistics of the training data; None if there are several and none is chosen.

    Raises:
        CheckpointError: they are not of that name, or normalised otherwise than ours.
    """
    chosen = chosen_statistics(source, processor.get("statistics") or {}, unnorm_key)
    if chosen is None:
        return None
    check_mask(source, "action", chosen["action"], config.normalizations()[ACTION_KEY].mask)
    return {ACTION_KEY: chosen["action"]}


def read_grid(source: Path, processor: Mapping[str, Any]) -> list[list[float]]:
    """Return the edges of the bins, axis by axis.

    Raises:
        CheckpointError: some are missing.
    """
    policy = processor.get("bin_policy") or {}
    try:
        return [[float(edge) for edge in policy[GRID_PARTS[name]][f"{name}_bins"]] for name in AXES]
    except KeyError as exc:
        raise CheckpointError(
            f"{source / PROCESSOR_FILE}: expected the edges of the action grid (bin_policy: translation and "
            f"rotation, each with its bins), found nothing for {exc}. Fetch the whole checkpoint."
        ) from exc


def _settle_head(
    source: Path, described: Mapping[str, Any], weights: dict[str, Tensor], wanted: Head | None
) -> bool:
    """Return whether Gemma has an output matrix of its own; leave it out of the weights if it has not."""
    sections = (described.get("text_config") or {}, described)
    is_tied = next((part["tie_word_embeddings"] for part in sections if "tie_word_embeddings" in part), True)
    has_own = wanted == "own" or (wanted is None and not is_tied)
    if has_own and HEAD not in weights:
        raise CheckpointError(
            f"{source}: expected {HEAD}, found none. Fetch the whole checkpoint, or use `--head tied` for "
            "files of a model that predicts tokens with its input matrix."
        )
    if has_own or HEAD not in weights:
        return has_own
    is_same = EMBEDDINGS in weights and torch.equal(weights[HEAD], weights[EMBEDDINGS])
    if wanted is None and not is_same:
        raise CheckpointError(
            f"{source}: {HEAD} differs from {EMBEDDINGS}, but {CONFIG_FILE} does not say so "
            "(tie_word_embeddings). Choose with `--head`: `tied` is what transformers makes of such files, "
            "`own` uses the tensor."
        )
    del weights[HEAD]
    return False


def _config(
    source: Path, processor: Mapping[str, Any], options: ConvertOptions, *, has_own_head: bool
) -> MikasaSpatialVLAConfig:
    shape = (3, options.camera_px, options.camera_px)
    chunk = processor.get("action_chunk_size")
    if not isinstance(chunk, int):
        raise CheckpointError(
            f"{source / PROCESSOR_FILE}: expected a number action_chunk_size, found {chunk}."
        )
    make: Any = MikasaSpatialVLAConfig  # lerobot, whose fields it has, is untyped
    config: MikasaSpatialVLAConfig = make(
        chunk_size=chunk,
        n_action_steps=chunk,
        inference_attention=ORIGINALS_INFERENCE,
        pictures=list(options.pictures),
        grid=read_grid(source, processor),
        sizes={**options.sizes, "llm_own_head": int(has_own_head)},
        dtype=options.dtype,
        device="cpu",
        push_to_hub=False,
    )
    config.input_features = {
        name: PolicyFeature(type=FeatureType.VISUAL, shape=shape) for name in options.cameras
    }
    config.output_features = {ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES),))}
    return config


def _check_tokenizer(source: Path, tokenizer: Any, sizes: NetworkSizes) -> None:
    made = tokenizer([prompt_text("pick the cube")], return_tensors="pt")
    try:
        finished(made.input_ids, made.attention_mask, sizes)
    except SpecMismatchError as exc:
        raise CheckpointError(
            f"{source}: {exc} Another version of transformers may read it otherwise."
        ) from exc
    if tokenizer.convert_tokens_to_ids("<image>") not in (sizes.image_token, tokenizer.unk_token_id, None):
        raise CheckpointError(
            f"{source}: expected the token <image> to have the number {sizes.image_token}, found "
            f"{tokenizer.convert_tokens_to_ids('<image>')}."
        )
