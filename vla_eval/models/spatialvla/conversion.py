"""Read a published SpatialVLA, to make a LeRobot checkpoint of it.

No code of the checkpoint is run. Names of weights come from the golden files and, for ZoeDepth, from
transformers; the released weights were not seen (docs/spatialvla.md), so what differs is an error. What the
JSON files look like: those of `spatialvla-4b-mix-224-pt`, kept at https://github.com/tannq-jo/pg-vla/tree/
d8d7cb42abebe2f4f785f75ca53b0f6933e33588/exp/models.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any  # JSON and lerobot

import torch
from torch import Tensor

from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.features import ACTION_KEY
from vla_eval.models.shared.original import (
    CONFIG_FILE,
    Original,
    Statistics,
    check_mask,
    chosen_statistics,
    read_safetensors,
    with_features,
)
from vla_eval.models.spatialvla.action_grid import AXES
from vla_eval.models.spatialvla.configuration_spatialvla import MikasaSpatialVLAConfig
from vla_eval.models.spatialvla.conversion_options import SpatialVLAOptions
from vla_eval.models.spatialvla.described import GRID_PARTS, PROCESSOR_FILE, check_described
from vla_eval.models.spatialvla.network import finished
from vla_eval.models.spatialvla.processor_spatialvla import (
    make_mikasa_spatialvla_pre_post_processors,
    prompt_text,
)
from vla_eval.models.spatialvla.sizes import Attention, NetworkSizes
from vla_eval.strict.json_fields import read_json

ORIGINALS_INFERENCE: Attention = "bidirectional"
"""What the prefix attends to when the original predicts, however it was trained: unless flash attention is
asked for, its mask hides no token of the prompt where there are no labels. Source: https://github.com/
SpatialVLA/SpatialVLA/blob/e48075326a92116adaaf1232cf01471f15f09a73/model/modeling_spatialvla.py#L258-L306."""


def read_original(source: Path, options: SpatialVLAOptions) -> Original:
    """Read a folder with `config.json`, `processor_config.json`, safetensors and tokenizer."""
    described, processor = read_json(source / CONFIG_FILE), read_json(source / PROCESSOR_FILE)
    weights = read_safetensors(source)
    has_own_head = _settle_head(source, described, weights, options.head)
    config = _config(source, processor, options, has_own_head=has_own_head)
    check_described(source, config.network_sizes())
    statistics = read_statistics(source, processor, config, options.unnorm_key)
    return Original(
        config=config,
        weights=lambda _: {f"network.{name}": value for name, value in to_ours(weights).items()},
        make_processors=lambda: make_mikasa_spatialvla_pre_post_processors(config, statistics),
        casts=True,
        check_tokenizer=lambda tokenizer: _check_tokenizer(source, tokenizer, config.network_sizes()),
    )


def read_statistics(
    source: Path, processor: Mapping[str, Any], config: MikasaSpatialVLAConfig, unnorm_key: str | None
) -> Statistics | None:
    """Return field -> statistics of the training data; None if there are several and none is chosen."""
    chosen = chosen_statistics(source, processor.get("statistics") or {}, unnorm_key)
    if chosen is None:
        return None
    check_mask(source, "action", chosen["action"], config.normalizations()[ACTION_KEY].mask)
    return {ACTION_KEY: chosen["action"]}


def read_grid(source: Path, processor: Mapping[str, Any]) -> list[list[float]]:
    """Return the edges of the bins, axis by axis."""
    policy = processor.get("bin_policy") or {}
    try:
        return [[float(edge) for edge in policy[GRID_PARTS[name]][f"{name}_bins"]] for name in AXES]
    except KeyError as exc:
        raise CheckpointError(
            f"{source / PROCESSOR_FILE}: expected the edges of the action grid (bin_policy: translation and "
            f"rotation, each with its bins), found nothing for {exc}. Fetch the whole checkpoint."
        ) from exc


def _settle_head(
    source: Path, described: Mapping[str, Any], weights: dict[str, Tensor], wanted: str | None
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
    source: Path, processor: Mapping[str, Any], options: SpatialVLAOptions, *, has_own_head: bool
) -> MikasaSpatialVLAConfig:
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
    cameras = dict.fromkeys(options.cameras, (options.camera_px, options.camera_px))
    return with_features(config, cameras)


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


# Beginnings of names, (original, ours); a name that begins with none of them is kept.
BEGINNINGS: tuple[tuple[str, str], ...] = (
    ("vision_tower.vision_model.", "vision."),
    ("language_model.lm_head.", "lm_head."),
    ("language_model.model.", "llm."),
    ("multi_modal_projector.linear.", "projector."),
    ("vision_zoe_model.", "depth.zoe."),
)
EMBEDDINGS, HEAD = "language_model.model.embed_tokens.weight", "language_model.lm_head.weight"


def to_ours(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the original's tensors under our names; an unknown name stays, and the loader refuses it."""
    renamed = {}
    for name, tensor in weights.items():
        old, new = next((pair for pair in BEGINNINGS if name.startswith(pair[0])), ("", ""))
        renamed[new + name.removeprefix(old)] = tensor
    return renamed
