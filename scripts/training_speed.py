"""Seconds of a training step of a recipe at its true size, with random weights on random samples."""

import shutil
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.checkpoints.loading import LoadOptions, load_weights, make_unfilled_policy, read_config
from vla_eval.checkpoints.processors import load_processors
from vla_eval.checkpoints.verify import random_batch
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY, DONE_KEY, REWARD_KEY
from vla_eval.models.shared.earlier_frames import SEGMENT_PADDING_KEY
from vla_eval.models.shared.stages import EPISODE_STEPS
from vla_eval.testing.process_memory import peak_device_bytes, reset_device_peak
from vla_eval.testing.random_checkpoint import built_tiny, stand_in_config, write_checkpoint
from vla_eval.training.batches import preprocessed
from vla_eval.training.cost.estimate import estimate
from vla_eval.training.loop import autocast_dtype
from vla_eval.training.policy_config import peft_config
from vla_eval.training.request import load_finetune_recipe

LEARNING_RATE = 1e-5
TINY_BATCH = 2


def measure_steps(
    name: str, folder: Path, *, device: str, n_steps: int, batch_size: int | None = None, tiny: bool = False
) -> dict[str, Any]:
    """Return seconds per step of a recipe (the mean of `n_steps` after the first), memory, and the estimate.

    A checkpoint of random weights is written to `folder`, and removed. Without `batch_size`, it is the
    recipe's, or two if tiny.
    """
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none")).value
    n_samples = batch_size or (TINY_BATCH if tiny or name.endswith("_tiny") else recipe.batch_size)
    folder.mkdir(parents=True)
    try:
        with built_tiny(recipe.type, tiny=tiny):
            return _measure(recipe, folder, device=device, n_steps=n_steps, n_samples=n_samples, tiny=tiny)
    finally:
        shutil.rmtree(folder)


def _measure(
    recipe: FinetuneRecipe, folder: Path, *, device: str, n_steps: int, n_samples: int, tiny: bool
) -> dict[str, Any]:
    config, tokenizer = stand_in_config(recipe, folder, dtype=None, tiny=tiny)
    model_folder = folder / "model"
    model_folder.mkdir()
    write_checkpoint(model_folder, config, make_unfilled_policy(config), tokenizer)
    reset_device_peak(device)
    options = LoadOptions(device=device)
    config = read_config(model_folder, options)
    model = load_weights(model_folder, config, options)
    adapters = peft_config(recipe, config)
    if adapters is not None:
        config.pretrained_path = model_folder
        model = model.wrap_with_peft(peft_cli_overrides=asdict(adapters))
    model.train()
    before, _ = load_processors(model_folder, config, tokenizer=None)
    batch = preprocessed(before, in_segments(random_samples(config, n_samples), config))
    trained = [x for x in model.parameters() if x.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=LEARNING_RATE)
    seconds = [_step(model, batch, optimizer, config, device) for _ in range(1 + n_steps)]
    peak = peak_device_bytes(device)
    found = estimate(model, config, recipe, device=device)
    return {
        "batch_size": n_samples,
        "trained": sum(x.numel() for x in trained),
        "first_step_seconds": seconds[0],
        "step_seconds": sum(seconds[1:]) / n_steps,
        "peak_device_bytes": peak,
        "estimated_device_bytes": None
        if found.cost is None
        else found.fixed_bytes + n_samples * found.cost.saved_bytes,
    }


def _step(model: Any, batch: dict[str, Any], optimizer: Any, config: Any, device: str) -> float:
    started = time.perf_counter()
    kind, dtype = torch.device(device).type, autocast_dtype(config, device)
    with torch.autocast(kind, dtype=dtype, enabled=dtype is not None):
        loss, _ = model.forward(batch)
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - started


def random_samples(config: Any, n_samples: int) -> dict[str, Any]:
    """Return random samples (B, …) with random chunks of actions."""
    draws = torch.Generator().manual_seed(0)
    one = random_batch(config, tuple(config.observation_delta_indices or ()), draws)
    batch: dict[str, Any] = {
        key: value.expand(n_samples, *value.shape[1:]).clone()
        if isinstance(value, Tensor)
        else value * n_samples
        for key, value in one.items()
    }
    n_actions = len(config.action_delta_indices)
    n_numbers = int(config.action_feature.shape[0])
    batch[ACTION_KEY] = torch.rand(n_samples, n_actions, n_numbers, generator=draws) * 2 - 1
    batch[ACTION_PADDING_KEY] = torch.zeros(n_samples, n_actions, dtype=torch.bool)
    n_rewards = len(config.reward_delta_indices or [0])
    batch[REWARD_KEY] = torch.zeros(n_samples, n_rewards)
    batch[f"{REWARD_KEY}_is_pad"] = torch.zeros(n_samples, n_rewards, dtype=torch.bool)
    batch[DONE_KEY] = torch.zeros(n_samples, dtype=torch.bool)
    return batch


def in_segments(samples: dict[str, Any], config: Any) -> dict[str, Any]:
    """Return samples (B, …) as a policy of this configuration is given them in training.

    With memory tokens a sample is a sequence of frames (B, T, …), as long as the longest episode needs. Other
    policies are given their samples as they are.
    """
    if not hasattr(config, "n_passes") or not config.memory_tokens:
        return samples
    n_segments = sum(config.n_passes(EPISODE_STEPS))
    inputs: dict[str, Any] = {
        key: value.unsqueeze(1).repeat_interleave(n_segments, dim=1) if isinstance(value, Tensor) else value
        for key, value in samples.items()
    }
    n_samples = len(samples[ACTION_KEY])
    inputs[SEGMENT_PADDING_KEY] = torch.zeros(n_samples, n_segments, dtype=torch.bool)
    return inputs
