"""What the original code of OpenVLA-OFT made of tiny random weights; see the README beside the files."""

import functools
import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from vla_eval.policies.openvla.network import OpenVLANetwork, Prompts
from vla_eval.policies.openvla.sizes import NetworkOptions, NetworkSizes
from vla_eval.policies.openvla.weight_names import to_ours
from vla_eval.policies.weights import put_weights

FOLDER = Path(__file__).parents[1] / "golden" / "openvla_oft"
TOLERANCE = 2e-5  # absolute, float32 on CPU; from the README of the golden files
SIZES = NetworkSizes(
    image_px=56,
    dino_width=32,
    dino_depth=3,
    dino_heads=2,
    siglip_width=48,
    siglip_depth=3,
    siglip_heads=3,
    siglip_mlp=96,
    llm_width=32,
    llm_depth=2,
    llm_heads=4,
    llm_mlp=64,
)
PROPRIO = 8


@functools.cache
def values() -> dict[str, Tensor]:
    return load_file(FOLDER / "io.safetensors")


@functools.cache
def config() -> dict[str, Any]:
    data: dict[str, Any] = json.loads((FOLDER / "config.json").read_text())
    return data


@functools.cache
def original_weights() -> dict[str, Tensor]:
    """Return all weights by the original's names, `vla.` left out; sparse tables filled up with zeros."""
    weights = {}
    for name, tensor in load_file(FOLDER / "weights.safetensors").items():
        name = name.removeprefix("vla.")
        if name.endswith("@rows"):
            table = torch.zeros(SIZES.vocabulary, tensor.shape[1])
            rows = load_file(FOLDER / "weights.safetensors")[f"vla.{name.removesuffix('@rows')}@row_ids"]
            table[rows] = tensor
            weights[name.removesuffix("@rows")] = table
        elif not name.endswith("@row_ids"):
            weights[name] = tensor
    return weights


def network(**options: Any) -> OpenVLANetwork:
    made = OpenVLANetwork(SIZES, NetworkOptions(**options))
    ours = to_ours(original_weights(), SIZES)
    wanted = made.state_dict()
    extra = ("action_head.", "proprio_projector.")
    ours = {name: value for name, value in ours.items() if name in wanted or not name.startswith(extra)}
    put_weights(made, ours, where="golden weights")
    return made.eval()


def pictures(n_cameras: int) -> Tensor:
    """Return (2, cameras, 3, 56, 56) in [0, 1]."""
    return values()["in.images"][:, :n_cameras].permute(0, 1, 4, 2, 3).float() / 255


def prompts(*names: str) -> Prompts:
    """Return prompts, padded to the same length; the empty token is there as the original appends it."""
    rows = []
    for name in names:
        ids = values()[f"in.{name}_input_ids"][0].tolist()
        rows.append(ids if ids[-1] == SIZES.empty_token else [*ids, SIZES.empty_token])
    return padded(rows)


def training_prompts() -> Prompts:
    ids, labels = values()["train.input_ids"], values()["train.labels"]
    rows = [row[: int((label != -100).nonzero()[0])].tolist() for row, label in zip(ids, labels, strict=True)]
    return padded(rows)


def padded(rows: list[list[int]]) -> Prompts:
    longest = max(map(len, rows))
    ids = torch.tensor([[*row, *[SIZES.pad_token] * (longest - len(row))] for row in rows])
    lengths = torch.tensor([len(row) for row in rows])[:, None]
    return Prompts(ids, torch.arange(longest) < lengths)
