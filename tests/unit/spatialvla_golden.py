"""What the original code of SpatialVLA made of tiny random weights; see the README beside the files."""

import functools
import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from vla_eval.policies.spatialvla.action_grid import ActionGrid, Gaussian, gaussian_grid
from vla_eval.policies.spatialvla.camera import intrinsics, resized_intrinsics
from vla_eval.policies.spatialvla.network import Inputs, Prompts, SpatialVLANetwork
from vla_eval.policies.spatialvla.sizes import NetworkSizes
from vla_eval.policies.spatialvla.weight_names import to_ours
from vla_eval.policies.weights import put_weights

FOLDER = Path(__file__).parents[1] / "golden" / "spatialvla"
LOGITS, ELSEWHERE = 5e-5, 2e-5  # absolute, float32 on CPU; from the README of the golden files
SMALL = {
    "image_px": 56,
    "siglip_width": 48,
    "siglip_depth": 2,
    "siglip_heads": 3,
    "siglip_mlp": 96,
    "llm_width": 64,
    "llm_depth": 2,
    "llm_heads": 4,
    "llm_kv_heads": 2,
    "llm_head_width": 16,
    "llm_mlp": 128,
    "llm_own_head": 0,
    "depth_layers": 0,  # what the depth model says is one of the inputs
    "theta_bins": 4,
    "phi_bins": 6,
    "r_bins": 3,
    "roll_bins": 4,
    "pitch_bins": 4,
    "yaw_bins": 4,
    "newline_token": 4,
    "image_token": 36,
    "first_action_token": 40,
}
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
SIZES = NetworkSizes(**SMALL)
CHUNK = 4


@functools.cache
def values() -> dict[str, Tensor]:
    return load_file(FOLDER / "io.safetensors")


@functools.cache
def config() -> dict[str, Any]:
    data: dict[str, Any] = json.loads((FOLDER / "config.json").read_text())
    return data


@functools.cache
def original_weights() -> dict[str, Tensor]:
    return load_file(FOLDER / "weights.safetensors")


def network() -> SpatialVLANetwork:
    made = SpatialVLANetwork(SIZES)
    put_weights(made, to_ours(original_weights()), where="golden weights")
    return made.eval()


def grid(name: str = "gaussian") -> ActionGrid:
    fitted = {axis: Gaussian(**values) for axis, values in config()["action_tokens"][name].items()}
    return gaussian_grid(fitted, SIZES.n_bins)


def camera(name: str = "mikasa") -> Tensor:
    described = config()["intrinsics"][name]
    size = {"height_px": described["height"], "width_px": described["width"]}
    if name == "mikasa":  # from the field of view alone
        matrix = intrinsics(**size, fov_rad=torch.pi / 2)
    else:
        matrix = torch.tensor(described["intrinsic"])
    return resized_intrinsics(matrix, **size, to_px=SIZES.image_px)


def inputs(pictures: list[list[int]], prompts: Prompts, matrix: Tensor | None = None) -> Inputs:
    """Return samples with these of the golden pictures, each seen by the camera of MIKASA, unless said."""
    chosen = torch.tensor(pictures)
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


def padded(rows: list[list[int]]) -> Prompts:
    longest = max(map(len, rows))
    ids = torch.tensor([[*row, *[SIZES.pad_token] * (longest - len(row))] for row in rows])
    lengths = torch.tensor([len(row) for row in rows])[:, None]
    return Prompts(ids, torch.arange(longest) < lengths)
