"""What the original code of SpatialVLA made of tiny random weights; see the README beside the files."""

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.models import golden_folder
from vla_eval.models.shared.greedy import Prompts
from vla_eval.models.spatialvla.action_grid import AXES, ActionGrid, Gaussian, gaussian_grid
from vla_eval.models.spatialvla.conversion import to_ours
from vla_eval.models.spatialvla.depth import zoe_config, zoe_depth
from vla_eval.models.spatialvla.described import GRID_PARTS
from vla_eval.models.spatialvla.ego3d import intrinsics, resized_intrinsics
from vla_eval.models.spatialvla.network import Inputs, SpatialVLANetwork
from vla_eval.models.spatialvla.sizes import NetworkSizes
from vla_eval.models.weights.exact import put_weights

FOLDER = Path(__file__).parents[2] / "golden" / "spatialvla"
LOGITS, ELSEWHERE = 5e-5, 2e-5  # absolute, float32 on CPU; from the README of the golden files
DEPTH = {
    "depth_px": 64,
    "depth_width": 32,
    "depth_layers": 4,
    "depth_heads": 2,
    "depth_mlp": 64,
    "depth_neck": 32,
    "depth_fusion": 16,
    "depth_features": 8,
    "depth_embedding": 16,
    "depth_bins": 16,
}
"""Sizes of a tiny depth model, for what the golden files do not hold."""


values = functools.partial(golden_folder.stored_values, FOLDER)
config = functools.partial(golden_folder.description, FOLDER)


def sizes_of(described: Mapping[str, Any]) -> dict[str, int]:
    """Return what the fixture's description says of sizes; depth is an input, so there is no model of it."""
    vision, llm, bins = described["vision"], described["llm"], described["action_tokens"]["num_bins"]
    parts = {**bins["translation"], **bins["rotation"]}
    return {
        "image_px": described["image_size"],
        "patch_px": described["patch_size"],
        "siglip_width": vision["hidden_size"],
        "siglip_depth": vision["num_hidden_layers"],
        "siglip_heads": vision["num_attention_heads"],
        "siglip_mlp": vision["intermediate_size"],
        "llm_width": llm["hidden_size"],
        "llm_depth": llm["num_hidden_layers"],
        "llm_heads": llm["num_attention_heads"],
        "llm_kv_heads": llm["num_key_value_heads"],
        "llm_head_width": llm["head_dim"],
        "llm_mlp": llm["intermediate_size"],
        "llm_own_head": int(not llm["tied_lm_head"]),
        "depth_layers": 0,
        **{f"{axis}_bins": parts[f"{axis}_bins"] for axis in AXES},
        "pad_token": described["pad_token_id"],
        "stop_token": described["eos_token_id"],
        "bos_token": described["bos_token_id"],
        "newline_token": described["newline_token_id"],
        "image_token": described["image_token_id"],
        "first_action_token": described["action_token_begin_idx"],
    }


def published_files(described: Mapping[str, Any], depth: Mapping[str, int]) -> dict[str, dict[str, Any]]:
    """Return the JSON files that the original would have written for the fixture, with a tiny depth model."""
    vision, llm, ego3d = described["vision"], described["llm"], described["ego3d"]
    tokens, processor = described["action_tokens"], described["image_processor"]
    numbers = {f"{name}_token_id": described[f"{name}_token_id"] for name in ("pad", "bos", "eos")}
    gelu = {"gelu tanh": "gelu_pytorch_tanh"}[vision["activation"]]
    ours = ("type", "tied_lm_head", "position_ids_start")  # the fixture's own words
    grid: dict[str, dict[str, list[float]]] = {"translation": {}, "rotation": {}}
    for name, edges in zip(AXES, golden_grid(tokens["gaussian"]).edges, strict=True):
        grid[GRID_PARTS[name]][f"{name}_bins"] = list(edges)
    return {
        "config.json": {
            "model_type": described["model"],
            "image_token_index": described["image_token_id"],
            "action_token_begin_idx": described["action_token_begin_idx"],
            "spatial_token_num": described["spatial_token_num"],
            "use_spatial_token": True,
            "use_vision_zoe": True,
            "ego3d_patch_reso": ego3d["patch_resolution"],
            "n_freqs": ego3d["n_freqs"],
            "projection_dim": llm["hidden_size"],
            **numbers,
            "text_config": {
                **{key: llm[key] for key in llm if key not in ours},
                **{"model_type": llm["type"], "tie_word_embeddings": llm["tied_lm_head"]},
            },
            "vision_config": {
                **{key: vision[key] for key in vision if key not in ("activation", "use_head")},
                **{"model_type": "siglip_vision_model", "hidden_act": gelu},
                **{"vision_use_head": vision["use_head"]},
                **{"image_size": described["image_size"], "patch_size": described["patch_size"]},
            },
            "vision_zoe_config": zoe_config(NetworkSizes(**depth)).to_dict(),
        },
        "processor_config.json": {
            "action_chunk_size": described["action_chunk_size"],
            "action_config": {
                "num_bins": plain(tokens["num_bins"]),
                "use_spherical": tokens["use_spherical"],
            },
            "bin_policy": grid,
            "intrinsic_config": plain(described["intrinsics"]),
            "statistics": plain(described["statistics"]),
        },
        "preprocessor_config.json": {
            "size": {"height": described["image_size"], "width": described["image_size"]},
            "resample": {"bicubic (PIL)": 3}[processor["resize"]],
            "rescale_factor": processor["rescale"],
            "do_normalize": processor["normalise_in_processor"],
            "image_seq_length": described["image_tokens"],
        },
        "generation_config.json": numbers,
    }


def write_published(folder: Path) -> Path:
    """Write the published files' names, golden weights and a tiny ZoeDepth; return the folder."""
    from transformers import PreTrainedTokenizerFast

    torch.manual_seed(0)
    sizes = {**SMALL, **DEPTH}
    depth = zoe_depth(NetworkSizes(**sizes)).state_dict()
    weights = {**original_weights(), **{f"vision_zoe_model.{name}": x for name, x in depth.items()}}
    names = sorted(weights)
    for index, part in enumerate((names[::2], names[1::2])):
        tensors = {name: weights[name].contiguous().clone() for name in part}
        save_file(tensors, folder / f"model-0000{index + 1}-of-00002.safetensors")
    for name, data in published_files(config(), sizes).items():
        (folder / name).write_text(json.dumps(data))
    make: Any = PreTrainedTokenizerFast
    special = {"pad_token": "<pad>", "bos_token": "<bos>", "eos_token": "<eos>", "unk_token": "<unk>"}
    make(tokenizer_file=str(FOLDER / "tokenizer.json"), **special).save_pretrained(str(folder))
    return folder


def plain(data: Any) -> Any:
    """Return the data as JSON has it."""
    return {key: plain(data[key]) for key in data} if isinstance(data, Mapping) else data


def golden_grid(gaussians: Mapping[str, Any]) -> ActionGrid:
    return gaussian_grid({axis: Gaussian(**gaussians[axis]) for axis in AXES}, SIZES.n_bins)


SMALL = sizes_of(config())
SIZES = NetworkSizes(**SMALL)
padded = functools.partial(golden_folder.padded, pad_token=SIZES.pad_token)
CHUNK: int = config()["action_chunk_size"]
ROOT_OF_WIDTH = math.sqrt(SIZES.llm_width)


@functools.cache
def original_weights() -> dict[str, Tensor]:
    return load_file(FOLDER / "weights.safetensors")


def network() -> SpatialVLANetwork:
    made = SpatialVLANetwork(SIZES)
    put_weights(made, to_ours(original_weights()), where="golden weights")
    return made.eval()


def grid(name: str = "gaussian") -> ActionGrid:
    return golden_grid(config()["action_tokens"][name])


def camera(name: str = "mikasa") -> Tensor:
    described = config()["intrinsics"][name]
    size = {"height_px": described["height"], "width_px": described["width"]}
    if name == "mikasa":  # from the field of view alone
        matrix = intrinsics(**size, fov_rad=torch.pi / 2)
    else:
        matrix = torch.tensor(described["intrinsic"])
    return resized_intrinsics(matrix, **size, to_px=SIZES.image_px)


def inputs(images: list[list[int]], prompts: Prompts, matrix: Tensor | None = None) -> Inputs:
    """Return samples with these of the golden images, each seen by the camera of MIKASA, unless said."""
    chosen = torch.tensor(images)
    shown = values()["in.images"][chosen].permute(0, 1, 4, 2, 3).float() / 255
    matrix = camera() if matrix is None else matrix
    return Inputs(shown, matrix.expand(*chosen.shape, 3, 3), prompts, values()["in.predicted_depth"][chosen])


def prompts(*indices: int) -> Prompts:
    """Return prompts without the patches before them, padded to the same length."""
    return padded([row[row != SIZES.image_token].tolist() for row in map(prompt_ids, indices)])


def prompt_ids(index: int) -> Tensor:
    return values()[f"prompt{index}.input_ids"][0]


def training_prompts(name: str) -> Prompts:
    ids, labels = values()[f"{name}.input_ids"], values()[f"{name}.labels"]
    rows = []
    for row, label in zip(ids, labels, strict=True):
        before = row[: int((label != -100).nonzero()[0])]
        rows.append(before[before != SIZES.image_token].tolist())
    return padded(rows)
