"""LoRA in a fine-tuning: which layers get an adapter, and a check that just these are trained."""

from typing import Any  # lerobot is untyped

from lerobot.configs.default import PeftConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class

from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.errors import RecipeError
from vla_eval.models.families import family_of
from vla_eval.models.weights.trainable import check_lora


def peft_config(recipe: FinetuneRecipe, policy: Any) -> PeftConfig | None:
    """Return lerobot's settings of the adapters of a policy; None: all weights are trained."""
    lora = recipe.lora
    if lora is None:
        return None
    return PeftConfig(
        r=lora.rank,
        lora_alpha=lora.alpha or lora.rank,
        target_modules=lora.target_modules or family_of(policy.type).lora_targets,
        full_training_modules=list(lora.full_modules) or None,
    )


def check_lora_targets(recipe: FinetuneRecipe, cls: Any) -> None:
    """Raise `RecipeError` where neither recipe nor policy class says which layers get an adapter."""
    if recipe.lora is None or recipe.lora.target_modules is not None:
        return
    if hasattr(cls, "lora_defaults"):
        return
    chosen = get_policy_class(recipe.type)._get_default_peft_targets
    if chosen is PreTrainedPolicy._get_default_peft_targets:
        raise RecipeError(
            f"finetune.lora.target_modules is not set, and '{recipe.type}' does not say itself which layers "
            f"get an adapter. Write a regular expression of whole module names, or leave `lora` out."
        )


def check_adapters(model: Any, recipe: FinetuneRecipe, policy: Any) -> None:
    """Raise `TrainingError` if LoRA trains others than the recipe asks for, else the policy's own choice."""
    if recipe.lora is None:
        return
    if getattr(policy, "memory_tokens", 0) and "memory_tokens" not in recipe.lora.full_modules:
        raise RecipeError(
            "finetune.lora: new memory tokens have nothing to adapt. Train them in full: "
            "finetune.lora.full_modules: [memory_tokens]"
        )
    own = policy.lora_defaults() if hasattr(policy, "lora_defaults") else {}
    target = recipe.lora.target_modules or family_of(policy.type).lora_targets or own.get("target_modules")
    if target is not None:
        check_lora(model, target, tuple(recipe.lora.full_modules or own.get("modules_to_save") or ()))
