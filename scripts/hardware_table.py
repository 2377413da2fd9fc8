"""Print the table of docs/hardware.md: what each recipe takes, estimated from shapes. Loads no weights."""

import tempfile
from pathlib import Path

from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.testing.random_checkpoint import stand_in_config
from vla_eval.training.estimate import estimate, unfilled_model
from vla_eval.training.job import load_finetune_recipe

RECIPES = (
    "octo_small",
    "octo_base",
    "smolvla",
    "pi0",
    "pi0_expert",
    "pi0_lora",
    "pi05",
    "pi05_expert",
    "pi05_lora",
    "pi0_fast",
    "spatialvla",
    "openvla_oft",
)
DEVICES_GB = (24, 48, 80)
SECONDS_PER_DAY = 86_400


def row(name: str, folder: Path) -> str:
    """Return the row of one recipe."""
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none")).value
    config, _ = stand_in_config(recipe, folder, dtype=None, tiny=False)
    found = estimate(unfilled_model(config, recipe), config, recipe, device="cuda")
    fits = [str(found.largest_batch(n * 1e9) or "—") for n in DEVICES_GB]
    days = (found.step_seconds or 0) * found.steps / SECONDS_PER_DAY
    assert found.cost is not None
    cells = [
        f"`{name}`",
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
    for name in RECIPES:
        with tempfile.TemporaryDirectory() as folder:
            print(row(name, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
