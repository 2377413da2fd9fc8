"""A table of learned policies with tiny random models, on the fake simulator, in minutes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from vla_eval.checkpoints.notes import LEROBOT_ADAPTER
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.files import load_recipe, to_data
from vla_eval.config.finetuning import merge_fields
from vla_eval.config.policy import PolicyRecipe, load_policy
from vla_eval.errors import RecipeError
from vla_eval.evaluation.model_table import ModelTable, TableRow
from vla_eval.models.families import FAMILIES, family_of
from vla_eval.storage.durable import replace_file
from vla_eval.testing.tiny_models import write_tiny_tokenizer

TINY_ADAPTER = "vla_eval.testing.tiny_models:make_tiny"
N_EPISODES = 2
N_STEPS = 2
SHORT = {
    "steps": N_STEPS,
    "batch_size": 2,
    "save_every_steps": N_STEPS,
    "log_every_steps": 1,
    "num_workers": 0,
}


def tiny_table(table: ModelTable, out: Path) -> tuple[ModelTable, dict[str, str]]:
    """Return the table with a tiny model in each row, and the adapters of rows that are not lerobot's."""
    rows, adapters = [], {}
    for row in table.rows:
        recipe, adapter = _tiny_recipe(row, out / "tiny")
        path = out / "tiny" / f"{row.name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, yaml.safe_dump(recipe, sort_keys=False, allow_unicode=True))
        rows.append(replace(row, policy=str(path), finetune=None))
        adapters[row.name] = adapter
    tiny = replace(
        table,
        name=f"{table.name}_tiny",
        rows=tuple(rows),
        datasets=str(out / "data"),
        steps=N_STEPS,
        run_seeds=table.run_seeds[:2],
        episodes=N_EPISODES,
        simulator="fake",
        env={},  # the fake simulator has the default control mode alone
        allow_unreplayed=True,
    )
    return tiny, adapters


def tiny_dataset(table: ModelTable) -> DatasetRecipe:
    """Return the recipe of demonstrations for a tiny table."""
    return DatasetRecipe(
        name="tiny", tasks=table.tasks, episodes=N_EPISODES, simulator="fake", workers=1, episodes_per_shard=2
    )


def _tiny_recipe(row: TableRow, folder: Path) -> tuple[dict[str, Any], str]:
    real = load_policy(row.policy).value.finetune
    kind = None if real is None else real.type
    family = family_of(str(kind))
    tiny, longest = family.tiny, max(row.n_action_steps)
    if tiny is None:
        known = ", ".join(family.type for family in FAMILIES.values() if family.tiny is not None)
        raise RecipeError(f"row {row.name}: there is no tiny form of the type {kind}. Known: {known}.")
    if family.built_tiny:
        tokenizer = str(write_tiny_tokenizer(folder / "tokenizer"))
        section: dict[str, Any] = {"type": kind, "tokenizer": tokenizer, "policy": {}}
    elif tiny.recipe:
        section = to_data(load_recipe("policies", tiny.recipe, PolicyRecipe).value.finetune)
    else:
        section = merge_fields(to_data(real), row.finetune or {})
    chunk = {"chunk_size": longest, "n_action_steps": longest} if tiny.sets_chunk else {}
    recipe = {
        "version": 1,
        "description": f"Tiny random weights in the place of {row.policy}.",
        "adapter": LEROBOT_ADAPTER,
        "default_n_action_steps": row.n_action_steps[0],
        "finetune": {**section, **SHORT, "policy": {**section["policy"], **tiny.fields, **chunk}},
    }
    return recipe, TINY_ADAPTER if family.built_tiny else LEROBOT_ADAPTER
