"""A folder of golden files: what an original's code made of tiny random weights, and its description."""

import functools
import json
from pathlib import Path
from typing import Any

import torch

from tests.models.golden_values import GoldenValues
from vla_eval.models.shared.greedy import Prompts


@functools.cache
def stored_values(folder: Path) -> GoldenValues:
    return GoldenValues(folder / "io.safetensors")


@functools.cache
def description(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "config.json").read_text())
    return data


def padded(rows: list[list[int]], *, pad_token: int) -> Prompts:
    longest = max(map(len, rows))
    ids = torch.tensor([[*row, *[pad_token] * (longest - len(row))] for row in rows])
    lengths = torch.tensor([len(row) for row in rows])[:, None]
    return Prompts(ids, torch.arange(longest) < lengths)
