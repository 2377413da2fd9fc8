"""What the JSON files of a published SpatialVLA say, field by field.

The network here is made for one architecture: what the files say is compared with it, and whatever they say
else is named with the reason why it is not. A field that says something else than what is implemented is an
error; so is one that stands in no list, for it may change what the model does. A missing field means what the
original's code makes of it.

Source: https://github.com/SpatialVLA/SpatialVLA/tree/e48075326a92116adaaf1232cf01471f15f09a73, model/
configuration_spatialvla.py:20, modeling_gemma2.py:330 and processing_spatialvla.py:38; the defaults of
Gemma 2, SigLIP and its image processor: transformers 4.47.0, with which the original runs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_eval.errors import CheckpointError
from vla_eval.models.shared.images import MAX_LEVEL
from vla_eval.models.shared.original import CONFIG_FILE
from vla_eval.models.shared.siglip import LAYER_NORM_EPS
from vla_eval.models.spatialvla.action_grid import AXES
from vla_eval.models.spatialvla.depth import zoe_config
from vla_eval.models.spatialvla.ego3d import CELLS, N_FREQUENCIES
from vla_eval.models.spatialvla.network import ATTENTION_CAP, GELU, LOGIT_CAP, RMS_NORM_EPS, ROPE_THETA
from vla_eval.models.spatialvla.sizes import SLIDING_WINDOW, NetworkSizes
from vla_eval.strict.json_fields import read_json

PROCESSOR_FILE, IMAGES_FILE, GENERATION_FILE = (
    "processor_config.json",
    "preprocessor_config.json",
    "generation_config.json",
)
GRID_PARTS = {name: "translation" if index < 3 else "rotation" for index, name in enumerate(AXES)}
BICUBIC = 3  # PIL's number of the filter
N_GRIPPER_BINS = 2


# Generating is greedy, with one beam, and nothing is forbidden, forced or made less likely.
GREEDY: Mapping[str, object] = {
    **{"num_beams": 1, "num_beam_groups": 1, "num_return_sequences": 1, "diversity_penalty": 0.0},
    **{"repetition_penalty": 1.0, "no_repeat_ngram_size": 0, "encoder_no_repeat_ngram_size": 0},
    **{"bad_words_ids": None, "suppress_tokens": None, "begin_suppress_tokens": None, "min_length": 0},
    **{"forced_bos_token_id": None, "forced_eos_token_id": None, "exponential_decay_length_penalty": None},
    **{"remove_invalid_values": False, "pruned_heads": {}},
}
# transformers may write these into any section; none changes what the original infers.
OF_NO_EFFECT = frozenset(
    {
        # how it was made and is kept
        *(
            "_attn_implementation_autoset",
            "_name_or_path",
            "architectures",
            "auto_map",
            "transformers_version",
        ),
        *("torch_dtype", "dtype", "initializer_range", "torchscript", "use_bfloat16", "tf_legacy_loss"),
        # what is returned, and what is for other kinds of models
        *("return_dict", "output_attentions", "output_hidden_states", "output_scores", "use_cache"),
        *("return_dict_in_generate", "chunk_size_feed_forward", "add_cross_attention", "is_decoder"),
        *("is_encoder_decoder", "cross_attention_hidden_size", "tie_encoder_decoder", "finetuning_task"),
        *("id2label", "label2id", "problem_type", "task_specific_params", "tokenizer_class", "prefix"),
        *("decoder_start_token_id", "sep_token_id", "cache_implementation", "_from_model_config"),
        # of sampling and of beams; `predict_action` asks for neither, and limits the length itself
        *("do_sample", "temperature", "top_k", "top_p", "typical_p", "length_penalty", "early_stopping"),
        *("max_length",),
    }
)


class Field(NamedTuple):
    """What a field has to say: our value, and the original's default; without one it has to be there."""

    ours: object
    default: object = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """What a section of a file may say: fields compared, and those read elsewhere or without effect."""

    where: str
    fields: Mapping[str, Field]
    elsewhere: frozenset[str] = frozenset()

    def problems(self, found: object) -> list[str]:
        """Return a line for each field that says something else."""
        if not isinstance(found, Mapping):
            return [f"{self.where}: expected a section of fields, found {found}"]
        known = {name: Field(value, value) for name, value in GREEDY.items()} | dict(self.fields)
        lines = []
        for name, (ours, default) in known.items():
            if name in found and _plain(found[name]) != _plain(ours):
                lines.append(f"{self.where}.{name}: expected {_plain(ours)}, found {found[name]}")
            if name not in found and default != ours:
                lines.append(
                    f"{self.where}.{name}: expected {_plain(ours)}, found nothing, which means {default}"
                )
        unknown = found.keys() - known.keys() - self.elsewhere - OF_NO_EFFECT
        return lines + [
            f"{self.where}.{name}: expected no such field, found {found[name]}; its effect is not known here"
            for name in sorted(unknown)
        ]


def _plain(value: object) -> object:
    """Return what JSON would make of it: no tuples."""
    return list(value) if isinstance(value, tuple) else value


def check_described(source: Path, sizes: NetworkSizes) -> None:
    """Raise unless all that the files of a published checkpoint say is that of a network of these sizes."""
    config, processor = read_json(source / CONFIG_FILE), read_json(source / PROCESSOR_FILE)
    images = read_json(source / IMAGES_FILE)
    lines = _top(sizes).problems(config)
    lines += _gemma(sizes).problems(config.get("text_config"))
    lines += _siglip(sizes).problems(config.get("vision_config"))
    if sizes.depth_layers:
        depth, encoder = _zoe(sizes)
        described = config.get("vision_zoe_config")
        lines += depth.problems(described)
        if isinstance(described, Mapping):
            lines += encoder.problems(described.get("backbone_config"))
    lines += _PROCESSOR.problems(processor)
    lines += _bins(sizes).problems(_flat_bins(processor.get("action_config")))
    lines += _images(sizes).problems(images)
    if (source / GENERATION_FILE).is_file():
        generation = Section(where=GENERATION_FILE, fields=_special_tokens(sizes))
        lines += generation.problems(read_json(source / GENERATION_FILE))
    if lines:
        raise CheckpointError(f"{source}: not the published SpatialVLA:\n  " + "\n  ".join(lines))


def _top(sizes: NetworkSizes) -> Section:
    return Section(
        where=CONFIG_FILE,
        fields={
            "model_type": Field("spatialvla", "spatialvla"),
            "image_token_index": Field(sizes.image_token, 256_000),
            "action_token_begin_idx": Field(sizes.first_action_token),
            "spatial_token_num": Field(sizes.n_action_tokens, 259),
            "use_spatial_token": Field(True, False),
            "use_vision_zoe": Field(True, True),
            "ego3d_patch_reso": Field(CELLS, 4),
            "n_freqs": Field(N_FREQUENCIES, 8),
            "projection_dim": Field(sizes.llm_width, 2048),
            **_special_tokens(sizes),
        },
        elsewhere=frozenset(
            {
                *("text_config", "vision_config", "vision_zoe_config"),  # sections of their own
                "tie_word_embeddings",  # `convert` settles where Gemma's output matrix is
                # The original reads neither: it takes those of `text_config`.
                *("hidden_size", "num_hidden_layers", "vocab_size", "_vocab_size"),
                "ignore_index",  # of the loss, the same in all of transformers
            }
        ),
    )


def _gemma(sizes: NetworkSizes) -> Section:
    return Section(
        where=f"{CONFIG_FILE}: text_config",
        fields={
            "model_type": Field("gemma2", "gemma2"),
            "vocab_size": Field(sizes.vocabulary, 256_000),
            "hidden_size": Field(sizes.llm_width, 2304),
            "intermediate_size": Field(sizes.llm_mlp, 9216),
            "num_hidden_layers": Field(sizes.llm_depth, 26),
            "num_attention_heads": Field(sizes.llm_heads, 8),
            "num_key_value_heads": Field(sizes.llm_kv_heads, 4),
            "head_dim": Field(sizes.llm_head_width, 256),
            # Attention is divided by the root of this, whatever the heads' width is.
            "query_pre_attn_scalar": Field(sizes.llm_head_width, 256),
            "hidden_activation": Field(GELU, GELU),
            "rms_norm_eps": Field(RMS_NORM_EPS, 1e-6),
            "rope_theta": Field(ROPE_THETA, 10_000.0),
            "attention_bias": Field(False, False),
            "attention_dropout": Field(0.0, 0.0),
            "sliding_window": Field(SLIDING_WINDOW, 4096),
            "attn_logit_softcapping": Field(ATTENTION_CAP, 50.0),
            "final_logit_softcapping": Field(LOGIT_CAP, 30.0),
        },
        elsewhere=frozenset(
            {
                "tie_word_embeddings",  # `convert` settles where Gemma's output matrix is
                "hidden_act",  # Gemma 2 reads `hidden_activation`
                "max_position_embeddings",  # rotary positions have no limit; a sequence is within a window
                "num_image_tokens",  # the original overwrites it by the number of patches
                # The prompt's and those of generating are at the top and in generation_config.json.
                *("pad_token_id", "bos_token_id", "eos_token_id"),
            }
        ),
    )


def _siglip(sizes: NetworkSizes) -> Section:
    return Section(
        where=f"{CONFIG_FILE}: vision_config",
        fields={
            "model_type": Field("siglip_vision_model", "siglip_vision_model"),
            "hidden_size": Field(sizes.siglip_width, 768),
            "intermediate_size": Field(sizes.siglip_mlp, 3072),
            "num_hidden_layers": Field(sizes.siglip_depth, 12),
            "num_attention_heads": Field(sizes.siglip_heads, 12),
            "num_channels": Field(3, 3),
            "image_size": Field(sizes.image_px, 224),
            "patch_size": Field(sizes.patch_px, 16),
            "hidden_act": Field(GELU, GELU),
            "layer_norm_eps": Field(LAYER_NORM_EPS, 1e-6),
            "attention_dropout": Field(0.0, 0.0),
            "vision_use_head": Field(False, True),
        },
        # The original takes the projector's width from the top, and counts patches itself.
        elsewhere=frozenset({"projection_dim", "num_image_tokens", "num_positions"}),
    )


# Of ZoeDepth's configuration as transformers 5.5 writes it, what no forward pass reads.
_NOT_OF_ZOE = frozenset(
    {"backbone_config", "dtype", "architectures", "_name_or_path", "id2label", "label2id"}
)
# Of BEiT: its pretraining, its heads for classes and segments, and dropout, which a frozen model has not.
_NOT_OF_ENCODER = frozenset(
    {
        *("add_fpn", "auxiliary_channels", "auxiliary_concat_input", "auxiliary_loss_weight", "vocab_size"),
        *("auxiliary_num_convs", "use_auxiliary_head", "pool_scales", "semantic_loss_ignore_index"),
        *("attention_probs_dropout_prob", "hidden_dropout_prob", "drop_path_rate", "layer_scale_init_value"),
        *("use_mean_pooling", "use_mask_token", "stage_names"),
    }
)


def _zoe(sizes: NetworkSizes) -> tuple[Section, Section]:
    """Return the sections of the depth model and of its vision encoder: what transformers writes for ours."""
    depth = zoe_config(sizes).to_dict()
    encoder = depth["backbone_config"]
    # The published file names every field; transformers' defaults stand for those that others leave out.
    depth, encoder = (
        {name: value for name, value in part.items() if name not in OF_NO_EFFECT | left_out}
        for part, left_out in ((depth, _NOT_OF_ZOE), (encoder, _NOT_OF_ENCODER | _NOT_OF_ZOE))
    )
    depth["backbone_hidden_size"] = sizes.depth_width  # the model notes it where its encoder does not
    tokens = frozenset({"bos_token_id", "eos_token_id", "pad_token_id", "tie_word_embeddings"})
    return (
        Section(
            where=f"{CONFIG_FILE}: vision_zoe_config",
            fields=_as_published(depth),
            # `backbone` and what is beside it name an encoder to be fetched; it is described instead.
            elsewhere=tokens | _NOT_OF_ZOE | {"backbone", "use_pretrained_backbone"},
        ),
        Section(
            where=f"{CONFIG_FILE}: vision_zoe_config.backbone_config",
            fields=_as_published(encoder),
            elsewhere=tokens | _NOT_OF_ZOE | _NOT_OF_ENCODER,
        ),
    )


def _as_published(fields: Mapping[str, object]) -> dict[str, Field]:
    return {name: Field(value, value) for name, value in fields.items()}


_PROCESSOR = Section(
    where=PROCESSOR_FILE,
    fields={"num_obs_steps": Field(1, 1)},
    elsewhere=frozenset(
        {
            *("action_chunk_size", "bin_policy", "statistics"),  # `convert` reads them
            "action_config",  # a section of its own
            "intrinsic_config",  # cameras are those of the evaluation, see `camera_fov_rad`
            "obs_delta",  # between several frames, of which there is one
            "min_sigma",  # of a grid that is made from Gaussians; the edges are stored
            *("processor_class", "chat_template"),  # which code reads it; no chat is held
        }
    ),
)


def _bins(sizes: NetworkSizes) -> Section:
    axes = {f"{name}_bins": Field(n_bins) for name, n_bins in zip(AXES, sizes.n_bins, strict=True)}
    return Section(
        where=f"{PROCESSOR_FILE}: action_config",
        fields={"use_spherical": Field(True), "gripper": Field(N_GRIPPER_BINS), **axes},
        # A sum of the others; and where the bins come from, whose edges are stored.
        elsewhere=frozenset({"total", "distribution"}),
    )


def _flat_bins(described: object) -> object:
    """Return `action_config` with the numbers of bins among its other fields."""
    if not isinstance(described, Mapping):
        return described
    flat = {name: value for name, value in described.items() if name != "num_bins"}
    for name, value in (described.get("num_bins") or {}).items():
        flat |= value if isinstance(value, Mapping) else {name: value}
    return flat


def _images(sizes: NetworkSizes) -> Section:
    size = {"height": sizes.image_px, "width": sizes.image_px}
    return Section(
        where=IMAGES_FILE,
        fields={
            "do_resize": Field(True, True),
            "size": Field(size, {"height": 224, "width": 224}),
            "resample": Field(BICUBIC, BICUBIC),
            "do_rescale": Field(True, True),
            "rescale_factor": Field(1 / MAX_LEVEL, 1 / MAX_LEVEL),
            "do_normalize": Field(False, True),  # the network does it, for SigLIP and for the depth model
            "image_seq_length": Field(sizes.n_patches),
        },
        # Means and deviations without normalising; frames are RGB; the original names its classes itself.
        elsewhere=frozenset(
            {"image_mean", "image_std", "do_convert_rgb", "image_processor_type", "processor_class"}
        ),
    )


def _special_tokens(sizes: NetworkSizes) -> dict[str, Field]:
    return {
        "pad_token_id": Field(sizes.pad_token),
        "bos_token_id": Field(sizes.bos_token),
        "eos_token_id": Field(sizes.stop_token),
    }
