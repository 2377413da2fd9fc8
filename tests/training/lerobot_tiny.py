"""The tiny settings of LeRobot's types of policy: one table, for the matrix in docs/lerobot_policies.md."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig

from tests.training.tiny_trainings import TINY_ACT
from vla_eval.checkpoints.loading import config_class
from vla_eval.testing import tiny_models

PALIGEMMA = {**tiny_models.TINY_POLICY, "gradient_checkpointing": False, "scheduler_decay_steps": 4}
CHUNK = {"chunk_size": 4, "n_action_steps": 4}
WAN = {
    **{"hidden_dim": 16, "ffn_dim": 16, "num_heads": 2, "attn_head_dim": 8, "num_layers": 1},
    **{"text_dim": 16, "freq_dim": 8, "eps": 1e-6},
}
RESNET = {"pretrained_backbone_weights": None, "spatial_softmax_num_keypoints": 4}
FLORENCE = {
    "vision_config": {
        **{"embed_dim": [8, 8], "depths": [1, 1], "num_heads": [1, 1], "num_groups": [1, 1]},
        **{
            "patch_size": [7, 3],
            "patch_stride": [4, 4],
            "patch_padding": [3, 1],
            "patch_prenorm": [False, True],
        },
        **{
            "window_size": 4,
            "projection_dim": 16,
            "max_temporal_embeddings": 4,
            "max_position_embeddings": 10,
        },
    },
    "text_config": {
        **{"d_model": 16, "encoder_layers": 1, "decoder_layers": 1, "vocab_size": tiny_models.VOCABULARY},
        **{"encoder_ffn_dim": 16, "decoder_ffn_dim": 16, "max_position_embeddings": 128},
        **{"encoder_attention_heads": 2, "decoder_attention_heads": 2},
    },
}


@dataclass(frozen=True, kw_only=True)
class Tiny:
    """How a type is built tiny.

    Attributes:
        fields: of its configuration.
        files: writes what the configuration names into a folder, and returns those fields.
        tokenizer: whether its processors take one that is not a field.
        built: a context in which LeRobot builds it tiny.
    """

    fields: Mapping[str, Any] = field(default_factory=dict)
    files: Callable[[Path], Mapping[str, Any]] = lambda folder: {}
    tokenizer: bool = False
    built: Callable[[], AbstractContextManager[None]] = nullcontext


def write_tiny_clip(folder: Path) -> Path:
    """Save a tiny CLIP with random weights, and its tokenizer, for the multi-task DiT; return its folder."""
    from transformers import CLIPConfig, CLIPModel

    tiny_models.write_tiny_tokenizer(folder)
    sizes = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    config: Any = CLIPConfig
    model: Any = CLIPModel
    made = config(
        text_config={
            **sizes,
            "vocab_size": tiny_models.VOCABULARY,
            "eos_token_id": tiny_models.SPECIAL_TOKENS.index("<eos>"),
        },
        vision_config={**sizes, "image_size": 32, "patch_size": 16},
        projection_dim=16,
    )
    model(made).save_pretrained(str(folder))
    return folder


def clip(folder: Path) -> Mapping[str, Any]:
    """Write a tiny CLIP, and return the fields of a multi-task DiT that name it."""
    name = str(write_tiny_clip(folder / "clip"))
    return {"vision_encoder_name": name, "text_encoder_name": name}


def paligemma(family: str) -> Tiny:
    return Tiny(fields=PALIGEMMA, tokenizer=True, built=lambda: tiny_models.tiny_paligemma(family))


def fast_tokenizers(folder: Path) -> Mapping[str, Any]:
    """Write the two tokenizers of π0-FAST, and return the fields that name them."""
    return {
        "text_tokenizer_name": str(
            tiny_models.write_tiny_tokenizer(folder / "text", n_tokens=tiny_models.VOCABULARY)
        ),
        "action_tokenizer_name": str(tiny_models.write_tiny_fast_tokenizer(folder / "actions")),
    }


def lerobots_types() -> list[str]:
    """Return the types that the installed LeRobot registers itself."""
    config_class("act", where="a test")  # registers all
    known = PreTrainedConfig.get_known_choices().items()
    return sorted(kind for kind, cls in known if cls.__module__.startswith("lerobot.policies."))


TINY: Mapping[str, Tiny] = {
    "act": Tiny(fields=TINY_ACT, built=tiny_models.tiny_resnet),
    "diffusion": Tiny(
        fields={
            **RESNET,
            **{"horizon": 8, "n_action_steps": 4, "num_inference_steps": 2, "down_dims": [16, 32]},
            **{"n_groups": 4, "diffusion_step_embed_dim": 16},
        },
        built=tiny_models.tiny_resnet,
    ),
    "fastwam": Tiny(
        fields={
            **{"proprio_dim": 10, "action_horizon": 4, "n_action_steps": 4, "num_video_frames": 5},
            **{"action_video_freq_ratio": 1, "image_size": [128, 256]},
            "video_dit_config": {**WAN, "patch_size": [1, 2, 2], "in_dim": 4, "out_dim": 4},
            "action_dit_config": {**WAN, "action_dim": 7},
        }
    ),
    "groot": Tiny(fields=CHUNK),
    "molmoact2": Tiny(fields=CHUNK),
    "pi0": paligemma("pi0"),
    "pi05": paligemma("pi05"),
    "pi0_fast": Tiny(
        fields={
            **{name: value for name, value in PALIGEMMA.items() if name != "num_inference_steps"},
            **{"validate_action_token_prefix": False, "max_decoding_steps": 6},
        },
        files=fast_tokenizers,
        tokenizer=True,
        built=lambda: tiny_models.tiny_paligemma("pi0_fast"),
    ),
    "smolvla": Tiny(
        fields={
            **CHUNK,
            **{"load_vlm_weights": False, "num_vlm_layers": 2, "resize_imgs_with_padding": [64, 64]},
            "num_steps": 2,
        },
        files=lambda folder: {"vlm_model_name": str(tiny_models.write_tiny_smolvlm(folder / "vlm"))},
    ),
    "tdmpc": Tiny(
        fields={
            **{"horizon": 3, "n_gaussian_samples": 8, "n_pi_samples": 4, "n_elites": 4, "cem_iterations": 2},
            **{"latent_dim": 8, "mlp_dim": 16, "image_encoder_hidden_dim": 4, "state_encoder_hidden_dim": 8},
        }
    ),
    "vqbet": Tiny(
        fields={
            **RESNET,
            **{"n_obs_steps": 3, "n_action_pred_token": 2, "action_chunk_size": 2, "crop_shape": [64, 64]},
            **{"vqvae_n_embed": 4, "vqvae_embedding_dim": 8, "vqvae_enc_hidden_dim": 8, "gpt_n_layer": 1},
            **{"gpt_n_head": 2, "gpt_input_dim": 16, "gpt_hidden_dim": 16, "gpt_output_dim": 16},
        },
        built=tiny_models.tiny_resnet,
    ),
    "wall_x": Tiny(fields=CHUNK),
    "xvla": Tiny(
        fields={
            **CHUNK,
            **{
                "florence_config": FLORENCE,
                "action_mode": "auto",
                "hidden_size": 16,
                "depth": 1,
                "num_heads": 2,
            },
            **{"len_soft_prompts": 2, "num_denoising_steps": 2, "resize_imgs_with_padding": [64, 64]},
        },
        files=lambda folder: {"tokenizer_name": str(tiny_models.write_tiny_tokenizer(folder / "bart"))},
    ),
    "multi_task_dit": Tiny(
        fields={
            **{
                "horizon": 8,
                "n_action_steps": 4,
                "num_train_timesteps": 4,
                "hidden_dim": 16,
                "num_layers": 1,
            },
            **{"num_heads": 2, "timestep_embed_dim": 8, "image_crop_shape": [32, 32]},
        },
        files=clip,
    ),
}
