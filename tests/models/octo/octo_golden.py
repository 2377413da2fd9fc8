"""What the original code of Octo made of tiny random weights; see the README beside the files."""

import functools
import json
from collections.abc import Mapping
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from tests.models import golden_folder
from tests.models.octo.tiny_octo import GOLDEN
from vla_eval.models.octo.diffusion_head import HeadSizes
from vla_eval.models.octo.flax_names import from_flax
from vla_eval.models.octo.transformer import OctoNetwork, TransformerSizes, Window

CONFIG: dict[str, Any] = json.loads((GOLDEN / "config.json").read_text())
TIGHT = 1e-5  # readouts, noise, samples, losses; absolute, float32 on CPU; from the README

values = functools.partial(golden_folder.stored_values, GOLDEN)


def original_weights() -> dict[str, Tensor]:
    return dict(load_file(GOLDEN / "weights.safetensors"))


def sizes() -> tuple[TransformerSizes, HeadSizes]:
    head, stem = CONFIG["action_head"], CONFIG["stem"]
    return (
        TransformerSizes(
            image_px={name: camera["image_size"] for name, camera in CONFIG["cameras"].items()},
            max_window=CONFIG["max_horizon"],
            language_tokens=CONFIG["language_tokens"],
            language_width=CONFIG["language_embedding_dim"],
            width=CONFIG["token_embedding_size"],
            layers=CONFIG["num_layers"],
            heads=CONFIG["num_attention_heads"],
            mlp_width=CONFIG["mlp_dim"],
            stem_channels=tuple(stem["features"]),
            stem_features=stem["num_features"],
        ),
        HeadSizes(
            condition=CONFIG["token_embedding_size"],
            chunk=head["action_horizon"],
            action=head["action_dim"],
            hidden=head["hidden_dim"],
            blocks=head["num_blocks"],
            time=head["time_dim"],
            diffusion_steps=head["diffusion_steps"],
            max_action=head["max_action"],
        ),
    )


def make_network(weights: Mapping[str, Tensor]) -> OctoNetwork:
    made = OctoNetwork(*sizes())
    converted = from_flax(weights)
    prefix = "network."
    own = {key.removeprefix(prefix): x for key, x in converted.items() if key.startswith(prefix)}
    made.load_state_dict(own, strict=True)
    return made


def window(io: Mapping[str, Tensor], case: str) -> Window:
    n_steps = io[f"{case}.timestep_pad_mask"].shape[1]
    images, masks = {}, {}
    for camera in CONFIG["cameras"]:
        frames = io[f"in.image_{camera}"][:, -n_steps:].permute(0, 1, 4, 2, 3).float()
        images[camera] = frames
        none = torch.zeros(frames.shape[:2], dtype=torch.bool)
        masks[camera] = io.get(f"{case}.pad_mask_{camera}", none)
    return Window(
        images=images,
        image_mask=masks,
        step_mask=io[f"{case}.timestep_pad_mask"],
        language_BLD=io["mid.language_embeddings"],
        language_mask=io[f"{case}.pad_mask_language"],
    )


def sampling_noise(io: Mapping[str, Tensor], case: str) -> Tensor:
    start, added = io[f"sample.{case}.x_init"][:, None], io[f"sample.{case}.z"].transpose(0, 1)
    return torch.cat([start, added], dim=1)[:, :, -1]  # of the window, the newest step is executed
