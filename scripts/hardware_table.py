"""Print the table of docs/hardware.md: what each recipe takes, estimated from shapes. Loads no weights."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any  # lerobot is untyped

from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe, LoraRecipe
from vla_eval.testing.random_checkpoint import published_sizes
from vla_eval.training.cost.estimate import estimate, unfilled_model
from vla_eval.training.job import load_finetune_recipe
from vla_eval.training.policy_config import check_lora_targets

Change = Mapping[str, Any]

LORA = LoraRecipe(rank=16)
RECIPES: tuple[tuple[str, str, Change], ...] = (
    ("act", "", {}),
    ("diffusion", "", {}),
    ("memory", "", {}),
    ("recurrent", "", {}),
    ("context", "", {}),
    ("bc_mlp", "", {}),
    ("decision_transformer", "", {}),
    ("rate", "", {}),
    ("gtrxl", "", {}),
    ("decision_mamba", "", {}),
    ("elmur", "", {}),
    ("cql", "", {}),
    ("iql", "", {}),
    ("octo_small", "", {}),
    ("octo_small", "full", {"policy": {"trained": "all"}}),
    ("octo_base", "", {}),
    ("octo_base", "full", {"policy": {"trained": "all"}}),
    ("smolvla", "", {}),
    ("smolvla", "LoRA", {"lora": LORA}),
    ("smolvla_frames", "", {}),
    ("smolvla_memory_tokens", "", {}),
    ("pi0", "", {}),
    ("pi0_expert", "", {}),
    ("pi0_lora", "", {}),
    ("pi05", "", {}),
    ("pi05_expert", "", {}),
    ("pi05_lora", "", {}),
    ("pi05_frames", "", {}),
    ("pi05_memory_tokens", "", {}),
    ("pi0_fast", "", {}),
    ("spatialvla", "", {}),
    ("spatialvla", "full", {"lora": None}),
    ("openvla_oft", "", {}),
    ("openvla_oft", "full", {"lora": None}),
)
"""Recipe, what is changed in words, and the changed fields of its `finetune` section; empty: as it is."""
DEVICES_GB = (24, 48, 80)
SECONDS_PER_DAY = 86_400


def row(name: str, changed: str, change: Change, sizes: Callable[[FinetuneRecipe], Any]) -> str:
    """Return the row of one recipe."""
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none")).value
    policy = {**recipe.policy, **change.get("policy", {})}
    recipe = dataclasses.replace(recipe, **{**change, "policy": policy})
    config = sizes(recipe)
    check_lora_targets(recipe, type(config))
    found = estimate(unfilled_model(config, recipe), config, recipe, device="cuda")
    fits = [str(found.largest_batch(n * 1e9) or "—") for n in DEVICES_GB]
    days = (found.step_seconds or 0) * found.steps / SECONDS_PER_DAY
    assert found.cost is not None
    cells = [
        f"`{name}`" + (f", {changed}" if changed else ""),
        f"{found.model.n_parameters / 1e6:,.0f}",
        f"{found.model.n_trained / 1e6:,.1f}",
        f"{found.fixed_bytes / 1e9:.1f}",
        f"{found.cost.saved_bytes / 1e9:.3f}",
        str(found.batch_size),
        *fits,
        f"{days:.2g}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    devices = " | ".join(f"batch in {n} GB" for n in DEVICES_GB)
    print(
        f"| recipe | parameters (M) | trained (M) | fixed (GB) | per sample (GB) | batch | {devices} | days |"
    )
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    with published_sizes() as sizes:
        for name, changed, change in RECIPES:
            print(row(name, changed, change, sizes), flush=True)


if __name__ == "__main__":
    main()
