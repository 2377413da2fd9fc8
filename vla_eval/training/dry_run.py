"""`finetune --dry-run`: what would run, and what it takes. Writes nothing; loads no weights."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch

from vla_eval.checkpoints.bases import how_to_get
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.loading import NO_DOWNLOADS, config_class
from vla_eval.checkpoints.plain_errors import plain_errors
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.data.opening import OpenDataset
from vla_eval.errors import CheckpointError
from vla_eval.features import CAMERA_KEYS, IMAGE_SHAPE
from vla_eval.models.families import bases
from vla_eval.models.shared.original import with_features
from vla_eval.policies.lerobot.device import choose_device
from vla_eval.training.cost.estimate import Estimate, estimate, estimate_lines, unfilled_model
from vla_eval.training.dataset import chosen_episodes, training_dataset
from vla_eval.training.policy_config import (
    asked_policy,
    check_lora_targets,
    decoded_policy,
    fit_to_dataset,
    used_frames,
)
from vla_eval.training.request import load_finetune_recipe, run_folder_of
from vla_eval.training.run_folder import newest_step

EEF_NUMBERS = 10  # of the state that recordings have


def assumed_config(recipe: FinetuneRecipe) -> Any:
    """Return the policy's configuration without base and dataset: published sizes, fields of recordings."""
    cls = config_class(recipe.type, where="finetune.type")
    known = cls.__dataclass_fields__
    closed = {name: value for name, value in NO_DOWNLOADS.items() if name in known}
    base = bases().get(Path(str(recipe.base_checkpoint)).name)
    data = {**closed, **(base.fields if base else {}), **recipe.policy, "device": "cpu", "push_to_hub": False}
    if "action_grid" in known:
        data["action_grid"] = "uniform"
    policy = decoded_policy(cls, data, recipe.type)
    height, width, _ = IMAGE_SHAPE
    cameras = {recipe.rename_cameras.get(name, name): (height, width) for name in CAMERA_KEYS.values()}
    with_features(policy, cameras, state=EEF_NUMBERS if getattr(policy, "reads_state", True) else 0)
    if hasattr(policy, "fit_to_actions"):
        policy.fit_to_actions(None, {})  # a uniform grid needs neither
    return policy


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRunOptions:
    """What is assumed: memory (None: the GPU's), rate, and a configuration without base or dataset."""

    device_bytes: float | None = None
    tflops: float | None = None
    assume: Callable[[FinetuneRecipe], Any] = assumed_config


def describe_finetuning(config: FinetuneConfig, options: DryRunOptions) -> list[str]:
    """Return lines for a person."""
    loaded = load_finetune_recipe(config)
    recipe = loaded.value
    out = run_folder_of(config)
    found, missing, passes = _estimate(config, recipe, options)
    done = newest_step(out)
    kind = "full" if recipe.lora is None else f"LoRA of rank {recipe.lora.rank}"
    lines = [
        f"fine-tuning: {loaded.name} ({recipe.type}, {kind}) on {config.dataset}, "
        f"run seed {config.run_seed}, to {out}" + (f", resuming from step {done}" if done else ""),
        *(f"not there: {line}" for line in missing),
    ]
    if passes is not None:
        lines.append(passes)
    return [*lines, *estimate_lines(found, device_bytes=options.device_bytes or _memory_here())]


def _estimate(
    config: FinetuneConfig, recipe: FinetuneRecipe, options: DryRunOptions
) -> tuple[Estimate, list[str], str | None]:
    """Return the estimate, what is missing for the real run, and a line about the dataset, if it is there."""
    # A memory that is named is that of a GPU, which need not be here.
    is_named = options.device_bytes is not None and config.device == "auto"
    device = "cuda" if is_named else choose_device(config.device)
    missing, dataset = [], None
    if Path(config.dataset).is_dir():
        dataset = training_dataset(Path(config.dataset), allow_unreplayed=config.allow_unreplayed)
    else:
        missing.append(f"the dataset {config.dataset}; its fields are taken to be those of recordings")
    cls = config_class(recipe.type, where="finetune.type")
    check_lora_targets(recipe, cls)
    base, folder = recipe.base_checkpoint, _base_folder(recipe)
    if base is not None and folder is None:
        missing.append(
            f"the base {base}; its sizes are taken to be the defaults of '{recipe.type}'.{how_to_get(base)}"
        )
    with plain_errors(base or "finetune.policy", recipe.type, "cannot be trained"):
        passes: str | None = None
        if dataset is not None and (base is None or folder is not None):
            policy = asked_policy(recipe, cls, folder, device="cpu")
            dataset = chosen_episodes(dataset, recipe, policy)
            fit_to_dataset(policy, recipe, dataset)
            passes = _passes(policy, dataset, recipe)
        else:
            policy = options.assume(recipe)
        model = unfilled_model(policy, recipe)
        found = estimate(model, policy, recipe, device=device, tflops=options.tflops)
    return found, missing, passes


def _passes(policy: Any, dataset: OpenDataset, recipe: FinetuneRecipe) -> str:
    n_samples, frames = recipe.steps * recipe.batch_size, used_frames(policy, dataset).n_used
    if getattr(policy, "whole_episodes", False):
        episodes = len(dataset.lengths)
        return (
            f"dataset: {episodes:,} episodes of {frames:,} frames, each a sample; "
            f"{n_samples / episodes:.1f} passes over them"
        )
    return f"dataset: {frames:,} frames begin a sample; {n_samples / frames:.1f} passes over them"


def _base_folder(recipe: FinetuneRecipe) -> Path | None:
    """Return the folder of the base's weights; None: there is no base, or it is not on this machine."""
    if recipe.base_checkpoint is None:
        return None
    try:
        return find_checkpoint(Path(recipe.base_checkpoint))
    except CheckpointError:
        return None


def _memory_here() -> float | None:
    return float(torch.cuda.get_device_properties(0).total_memory) if torch.cuda.is_available() else None
