"""Tiny OpenVLA and SpatialVLA with the statistics of a dataset, and frames for them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from tests.training.fitted_policies import policy_config
from vla_eval.config.files import load_recipe
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.models.openvla import processor_openvla
from vla_eval.models.openvla.modeling_openvla import MikasaOpenVLAPolicy
from vla_eval.models.openvla.processor_openvla import make_mikasa_openvla_pre_post_processors
from vla_eval.models.spatialvla import processor_spatialvla
from vla_eval.models.spatialvla.modeling_spatialvla import MikasaSpatialVLAPolicy
from vla_eval.models.spatialvla.processor_spatialvla import make_mikasa_spatialvla_pre_post_processors
from vla_eval.training.dataset import training_dataset

BASE, WRIST = "observation.images.base", "observation.images.wrist"
BOTH = [BASE, WRIST]


@dataclass(frozen=True, kw_only=True)
class Ported:
    """What tests need to know of a ported policy.

    Attributes:
        recipe: name of its tiny recipe.
        chunk: actions of the tiny one's chunk.
        layers: its language model's blocks, from the network on.
    """

    recipe: str
    chunk: int
    layers: str
    policy: Any  # a PreTrainedPolicy: lerobot is untyped
    make_processors: Any
    prompt_text: Callable[[str], str]


OPENVLA = Ported(
    recipe="openvla_oft_tiny",
    chunk=8,
    layers="llm.model.layers",
    policy=MikasaOpenVLAPolicy,
    make_processors=make_mikasa_openvla_pre_post_processors,
    prompt_text=processor_openvla.prompt_text,
)
SPATIALVLA = Ported(
    recipe="spatialvla_tiny",
    chunk=4,
    layers="llm.layers",
    policy=MikasaSpatialVLAPolicy,
    make_processors=make_mikasa_spatialvla_pre_post_processors,
    prompt_text=processor_spatialvla.prompt_text,
)


def section(name: str) -> FinetuneRecipe:
    found = load_recipe("policies", name, PolicyRecipe).value.finetune
    assert found is not None
    return found


def tiny(ported: Ported, recorded: Path, **fields: Any) -> tuple[Any, Any, Any]:
    """Return policy, preprocessor and postprocessor."""
    torch.manual_seed(0)
    dataset = training_dataset(recorded, allow_unreplayed=True)
    found = section(ported.recipe)
    recipe = FinetuneRecipe(type=found.type, policy={**found.policy, **fields})
    config = policy_config(recipe, dataset, device="cpu")
    return ported.policy(config), *ported.make_processors(config, dataset.meta.stats)


def frames(n: int = 2, *, chunk: int) -> dict[str, Any]:
    draws = torch.Generator().manual_seed(1)
    return {
        BASE: torch.rand(n, 3, 128, 128, generator=draws),
        WRIST: torch.rand(n, 3, 128, 128, generator=draws),
        "observation.state": torch.rand(n, 10, generator=draws),
        "action": torch.rand(n, chunk, 7, generator=draws) * 0.2,
        "action_is_pad": torch.zeros(n, chunk, dtype=torch.bool),
        "task": ["Touch it", "Remember the color of the cube"][:n],
    }
