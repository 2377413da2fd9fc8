"""Configurations of policies, as a fine-tuning makes them."""

from pathlib import Path
from typing import Any

from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.loading import config_class
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.data.opening import OpenDataset
from vla_eval.training.policy_config import asked_policy, fit_to_dataset


def policy_config(recipe: FinetuneRecipe, dataset: OpenDataset, *, device: str) -> Any:
    base = find_checkpoint(Path(recipe.base_checkpoint)) if recipe.base_checkpoint else None
    cls = config_class(recipe.type, where="test")
    policy = asked_policy(recipe, cls, base, device=device)
    fit_to_dataset(policy, recipe, dataset)
    return policy
