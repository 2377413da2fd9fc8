"""What the JSON files of a published SpatialVLA say, field by field.

The network here is made for one architecture: what the files say is compared with it, and whatever they say
else is named with the reason why it is not (`sections`).

Source: https://github.com/SpatialVLA/SpatialVLA/tree/e48075326a92116adaaf1232cf01471f15f09a73, model/
configuration_spatialvla.py:20, modeling_gemma2.py:330 and processing_spatialvla.py:38; the defaults of
Gemma 2, SigLIP and its image processor: transformers 4.47.0, with which the original runs.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any  # JSON

from vla_eval.errors import CheckpointError
from vla_eval.policies.checkpoint import CONFIG_FILE, read_json
from vla_eval.policies.spatialvla.action_grid import AXES
from vla_eval.policies.spatialvla.depth import zoe_config
from vla_eval.policies.spatialvla.ego3d import CELLS, N_FREQUENCIES
from vla_eval.policies.spatialvla.network import (
    ATTENTION_CAP,
    GELU,
    LAYER_NORM_EPS,
    LOGIT_CAP,
    RMS_NORM_EPS,
    ROPE_THETA,
)
from vla_eval.policies.spatialvla.sections import OF_NO_EFFECT, Section
from vla_eval.policies.spatialvla.sizes import SLIDING_WINDOW, NetworkSizes
from vla_eval.policies.steps.images import MAX_LEVEL

PROCESSOR_FILE, PICTURES_FILE, GENERATION_FILE = (
    "processor_config.json",
    "preprocessor_config.json",
    "generation_config.json",
)
GRID_PARTS = {name: "translation" if index < 3 else "rotation" for index, name in enumerate(AXES)}
BICUBIC = 3  # PIL's number of the filter
N_GRIPPER_BINS = 2


def check_described(source: Path, sizes: NetworkSizes) -> None:
    """Compare all that the files say with what is implemented.

    Args:
        source: folder of the published checkpoint.
        sizes: of the network that its weights are to be loaded into.

    Raises:
        CheckpointError: a file is missing, or says something else or something that is not known here.
    """
    config, processor = read_json(source / CONFIG_FILE), read_json(source / PROCESSOR_FILE)
    pictures = read_json(source / PICTURES_FILE)
    lines = _top(sizes).problems(config)
    lines += _gemma(sizes).problems(config.get("text_config"))
    lines += _siglip(sizes).problems(config.get("vision_config"))
    if sizes.depth_layers:
        depth, eye = _zoe(sizes)
        described = config.get("vision_zoe_config")
        lines += depth.problems(described)
        if isinstance(described, Mapping):
            lines += eye.problems(described.get("backbone_config"))
    lines += _PROCESSOR.problems(processor)
    lines += _bins(sizes).problems(_flat_bins(processor.get("action_config")))
    lines += _pictures(sizes).problems(pictures)
    if (source / GENERATION_FILE).is_file():
        lines += _generation(sizes).problems(read_json(source / GENERATION_FILE))
    if lines:
        raise CheckpointError(f"{source}: not the published SpatialVLA:\n  " + "\n  ".join(lines))


def _top(sizes: NetworkSizes) -> Section:
    return Section(
        where=CONFIG_FILE,
        expected={
            "model_type": "spatialvla",
            "image_token_index": sizes.image_token,
            "action_token_begin_idx": sizes.first_action_token,
            "spatial_token_num": sizes.n_action_tokens,
            "use_spatial_token": True,
            "use_vision_zoe": True,
            "ego3d_patch_reso": CELLS,
            "n_freqs": N_FREQUENCIES,
            "projection_dim": sizes.llm_width,
            **_special_tokens(sizes),
        },
        missing={
            **{"model_type": "spatialvla", "image_token_index": 256_000, "spatial_token_num": 259},
            **{"use_spatial_token": False, "use_vision_zoe": True, "ego3d_patch_reso": 4, "n_freqs": 8},
            "projection_dim": 2048,
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
        expected={
            "model_type": "gemma2",
            "vocab_size": sizes.vocabulary,
            "hidden_size": sizes.llm_width,
            "intermediate_size": sizes.llm_mlp,
            "num_hidden_layers": sizes.llm_depth,
            "num_attention_heads": sizes.llm_heads,
            "num_key_value_heads": sizes.llm_kv_heads,
            "head_dim": sizes.llm_head_width,
            # Attention is divided by the root of this, whatever the heads' width is.
            "query_pre_attn_scalar": sizes.llm_head_width,
            "hidden_activation": GELU,
            "rms_norm_eps": RMS_NORM_EPS,
            "rope_theta": ROPE_THETA,
            "attention_bias": False,
            "attention_dropout": 0.0,
            "sliding_window": SLIDING_WINDOW,
            "attn_logit_softcapping": ATTENTION_CAP,
            "final_logit_softcapping": LOGIT_CAP,
        },
        missing={
            **{"model_type": "gemma2", "vocab_size": 256_000, "hidden_size": 2304, "intermediate_size": 9216},
            **{"num_hidden_layers": 26, "num_attention_heads": 8, "num_key_value_heads": 4, "head_dim": 256},
            **{"query_pre_attn_scalar": 256, "hidden_activation": GELU, "rms_norm_eps": 1e-6},
            **{"rope_theta": 10_000.0, "attention_bias": False, "attention_dropout": 0.0},
            **{"sliding_window": 4096, "attn_logit_softcapping": 50.0, "final_logit_softcapping": 30.0},
        },
        elsewhere=frozenset(
            {
                "tie_word_embeddings",  # `convert` settles where Gemma's output matrix is
                "hidden_act",  # Gemma 2 reads `hidden_activation`
                "max_position_embeddings",  # places turn without end; a sequence is shorter than a window
                "num_image_tokens",  # the original overwrites it by the number of patches
                # The prompt's and those of generating are told at the top and by generation_config.json.
                *("pad_token_id", "bos_token_id", "eos_token_id"),
            }
        ),
    )


def _siglip(sizes: NetworkSizes) -> Section:
    return Section(
        where=f"{CONFIG_FILE}: vision_config",
        expected={
            "model_type": "siglip_vision_model",
            "hidden_size": sizes.siglip_width,
            "intermediate_size": sizes.siglip_mlp,
            "num_hidden_layers": sizes.siglip_depth,
            "num_attention_heads": sizes.siglip_heads,
            "num_channels": 3,
            "image_size": sizes.image_px,
            "patch_size": sizes.patch_px,
            "hidden_act": GELU,
            "layer_norm_eps": LAYER_NORM_EPS,
            "attention_dropout": 0.0,
            "vision_use_head": False,
        },
        missing={
            **{"model_type": "siglip_vision_model", "hidden_size": 768, "intermediate_size": 3072},
            **{"num_hidden_layers": 12, "num_attention_heads": 12, "num_channels": 3, "image_size": 224},
            **{"patch_size": 16, "hidden_act": GELU, "layer_norm_eps": 1e-6, "attention_dropout": 0.0},
            "vision_use_head": True,
        },
        # The original takes the projector's width from the top, and counts patches itself.
        elsewhere=frozenset({"projection_dim", "num_image_tokens", "num_positions"}),
    )


# Of ZoeDepth's configuration as transformers 5.5 writes it, what no forward pass reads.
_NOT_OF_ZOE = frozenset(
    {"backbone_config", "dtype", "architectures", "_name_or_path", "id2label", "label2id"}
)
# Of BEiT: its pretraining, its heads for classes and segments, and dropout, which a frozen model has not.
_NOT_OF_EYE = frozenset(
    {
        *("add_fpn", "auxiliary_channels", "auxiliary_concat_input", "auxiliary_loss_weight", "vocab_size"),
        *("auxiliary_num_convs", "use_auxiliary_head", "pool_scales", "semantic_loss_ignore_index"),
        *("attention_probs_dropout_prob", "hidden_dropout_prob", "drop_path_rate", "layer_scale_init_value"),
        *("use_mean_pooling", "use_mask_token", "stage_names"),
    }
)


def _zoe(sizes: NetworkSizes) -> tuple[Section, Section]:
    """Return the sections of the depth model and of its eye: what transformers says of ours."""
    depth = zoe_config(sizes).to_dict()
    eye = depth["backbone_config"]
    # The published file names every field; transformers' defaults stand for those that others leave out.
    depth, eye = (
        {name: value for name, value in part.items() if name not in OF_NO_EFFECT | left_out}
        for part, left_out in ((depth, _NOT_OF_ZOE), (eye, _NOT_OF_EYE | _NOT_OF_ZOE))
    )
    depth["backbone_hidden_size"] = sizes.depth_width  # the model notes it where its eye does not say it
    tokens = frozenset({"bos_token_id", "eos_token_id", "pad_token_id", "tie_word_embeddings"})
    return (
        Section(
            where=f"{CONFIG_FILE}: vision_zoe_config",
            expected=depth,
            missing=depth,
            # `backbone` and what is beside it name an eye to be fetched; it is described instead.
            elsewhere=tokens | _NOT_OF_ZOE | {"backbone", "use_pretrained_backbone"},
        ),
        Section(
            where=f"{CONFIG_FILE}: vision_zoe_config.backbone_config",
            expected=eye,
            missing=eye,
            elsewhere=tokens | _NOT_OF_ZOE | _NOT_OF_EYE,
        ),
    )


_PROCESSOR = Section(
    where=PROCESSOR_FILE,
    expected={"num_obs_steps": 1},
    missing={"num_obs_steps": 1},
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
    axes = {f"{name}_bins": n_bins for name, n_bins in zip(AXES, sizes.n_bins, strict=True)}
    return Section(
        where=f"{PROCESSOR_FILE}: action_config",
        expected={"use_spherical": True, "gripper": N_GRIPPER_BINS, **axes},
        # A sum of the others; and where the bins come from, whose edges are stored.
        elsewhere=frozenset({"total", "distribution"}),
    )


def _flat_bins(described: object) -> object:
    """Return `action_config` with the numbers of bins beside its other fields."""
    if not isinstance(described, Mapping):
        return described
    flat = {name: value for name, value in described.items() if name != "num_bins"}
    for name, value in (described.get("num_bins") or {}).items():
        flat |= value if isinstance(value, Mapping) else {name: value}
    return flat


def _pictures(sizes: NetworkSizes) -> Section:
    size = {"height": sizes.image_px, "width": sizes.image_px}
    return Section(
        where=PICTURES_FILE,
        expected={
            **{"do_resize": True, "size": size, "resample": BICUBIC},
            **{"do_rescale": True, "rescale_factor": 1 / MAX_LEVEL},
            "do_normalize": False,  # the network does it, for SigLIP and for the depth model
            "image_seq_length": sizes.n_patches,
        },
        missing={
            **{"do_resize": True, "size": {"height": 224, "width": 224}, "resample": BICUBIC},
            **{"do_rescale": True, "rescale_factor": 1 / MAX_LEVEL, "do_normalize": True},
        },
        # Means and deviations without normalising; frames are RGB; the original names its classes itself.
        elsewhere=frozenset(
            {"image_mean", "image_std", "do_convert_rgb", "image_processor_type", "processor_class"}
        ),
    )


def _generation(sizes: NetworkSizes) -> Section:
    return Section(where=GENERATION_FILE, expected=_special_tokens(sizes))


def _special_tokens(sizes: NetworkSizes) -> dict[str, Any]:
    return {
        "pad_token_id": sizes.pad_token,
        "bos_token_id": sizes.bos_token,
        "eos_token_id": sizes.stop_token,
    }
