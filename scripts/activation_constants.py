"""Measure what small policies keep for the backward pass, as a constant per number that their layers handle.

`finetune --dry-run` estimates memory with these constants (`vla_eval/training/cost/sample_cost.py`). Networks
of the recipes' sizes with random weights, on a CPU, in two minutes. What autograd saves is counted for two
batches; the difference is that of the samples alone. Other sizes show whether the constant is one.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch
from lerobot.policies import make_pre_post_processors
from torch import Tensor
from training_speed import random_samples

from vla_eval.checkpoints.loading import make_unfilled_policy
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.models.families import family_of
from vla_eval.testing.random_checkpoint import plain_statistics, stand_in_config
from vla_eval.training.cost.sample_cost import count
from vla_eval.training.job import load_finetune_recipe

FEW, MORE = 1, 3  # samples
SEQUENCE_RECIPES = (
    *("recurrent", "context", "bc_mlp"),
    *("decision_transformer", "rate", "gtrxl", "decision_mamba", "elmur"),
)
VARIANTS: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("act", {}),
    ("act", {"chunk_size": 64, "dim_model": 256}),
    ("diffusion", {}),
    ("diffusion", {"horizon": 32, "use_separate_rgb_encoder_per_camera": False}),
    ("diffusion_small", {}),
    ("memory", {"window_steps": 60}),
    ("memory", {"window_steps": 90, "patch_px": 16}),
    *((name, {"window_steps": 60}) for name in SEQUENCE_RECIPES),
    ("recurrent", {"window_steps": 90, "encoder": "nature"}),
    *((name, {}) for name in ("cql", "cql_published", "iql")),
)


def saved_bytes(model: Any, batch: dict[str, Any]) -> int:
    """Return how much memory the tensors take that autograd saves in a forward pass."""
    own = {parameter.untyped_storage().data_ptr() for parameter in model.parameters()}
    kept: dict[int, Any] = {}  # the storages themselves: a place that is freed could be used again

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in own:
            kept[storage.data_ptr()] = storage
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        loss, _ = model.forward(batch)
    del loss
    return sum(storage.nbytes() for storage in kept.values())


def measure(name: str, changes: Mapping[str, Any]) -> str:
    """Return a line: numbers kept per sample, numbers that the layers handle, and their ratio."""
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none")).value
    recipe = replace(recipe, policy={**recipe.policy, **changes})
    with tempfile.TemporaryDirectory() as folder:
        config, _ = stand_in_config(recipe, Path(folder), dtype=None, tiny=False)
    torch.manual_seed(0)
    model = make_unfilled_policy(config).train()
    before, _ = make_pre_post_processors(config, dataset_stats=plain_statistics(config))
    few, more = (saved_bytes(model, before(random_samples(config, n))) for n in (FEW, MORE))
    numbers = (more - few) / (MORE - FEW) / torch.float32.itemsize
    handled = count(model, config).saved
    return (
        f"{name} {dict(changes)}: {numbers / 1e6:.2f} M numbers kept per sample, {handled / 1e6:.2f} M "
        f"handled: {numbers / handled:.2f} (in use: {family_of(config.type).saved_per_linear})"
    )


def main() -> None:
    """Print them."""
    for name, changes in VARIANTS:
        print(measure(name, changes), flush=True)


if __name__ == "__main__":
    main()
