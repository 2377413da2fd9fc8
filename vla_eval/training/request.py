"""What a fine-tuning is asked for, and whether its folder has all of it. Waits for no torch."""

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_eval.checkpoints.files import checkpoint_sha256, file_sha256, find_checkpoint
from vla_eval.config.agents import AgentRecipe
from vla_eval.config.files import Recipe, digest_of, list_recipes, to_data
from vla_eval.config.finetuning import LOGGERS, FinetuneConfig, FinetuneRecipe
from vla_eval.config.policy import changed_section, load_policy
from vla_eval.data.dataset_folder import require_finished
from vla_eval.data.facts import KINDS
from vla_eval.data.info_file import one_dataset
from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.tasks.catalog import task_spec
from vla_eval.training.held_out import HeldOut
from vla_eval.training.run_folder import REQUEST_KEY, newest_step, read_metrics, read_record


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneSummary:
    """The step of the newest checkpoint, 0 if there is none, and whether a call has done all."""

    out: Path
    step: int
    is_finished: bool

    @property
    def checkpoint(self) -> Path:
        """The checkpoint that an evaluation takes; `CheckpointError` if there is none yet."""
        return find_checkpoint(self.out)

    def __str__(self) -> str:
        """Return a line for a person, of a training that is finished."""
        return f"finished: {self.out} has all of its {self.step} steps. More: --steps (docs/finetuning.md)"


def load_finetune_recipe(config: FinetuneConfig) -> Recipe[FinetuneRecipe]:
    """Return the policy's recipe for fine-tuning, with the configuration's values on top."""
    name = config.policy
    if os.path.isdir(name) and Path(name).name not in list_recipes("policies"):
        raise RecipeError(_no_recipe(Path(name)))
    recipe = load_policy(name)
    if recipe.value.finetune is None:
        instead = "there is nothing to train"
        if recipe.value.train_agent is not None:
            instead = f"it learns by rewards: mikasa-vla train-agent --policy {recipe.name} --task TASK"
        raise RecipeError(
            f"policies/{recipe.name}.yaml has no section `finetune`: {instead}. "
            f"`mikasa-vla list policies` shows the recipes."
        )
    return changed_section(recipe, "finetune", FinetuneRecipe, config.finetune)


def _no_recipe(folder: Path) -> str:
    """Return what to do with a folder that was named in place of a recipe."""
    named = shlex.quote(str(folder))
    record = read_record(folder)
    if record:
        return (
            f"{folder}: is a run of policy '{record.get('policy')}', not a recipe. To continue it, repeat "
            f"its command, with more --steps if it is finished: {record.get('command')}. To start another "
            f"training from its weights: --policy {record.get('policy')} --base-checkpoint {named}"
        )
    try:
        find_checkpoint(folder)
    except CheckpointError:
        return (
            f"{folder}: is a folder without a checkpoint, not a recipe. Expected the name of a recipe "
            "(`mikasa-vla list policies`), or its file."
        )
    return (
        f"{folder}: is a checkpoint, not a recipe. To start from its weights, name the recipe of its kind: "
        f"--policy RECIPE --base-checkpoint {named}"
    )


def look_for(config: FinetuneConfig, *, is_dry: bool = False) -> None:
    """Look for recipe, dataset and base (not in a dry run), before torch is loaded."""
    recipe = load_finetune_recipe(config).value
    if is_dry and not os.path.isdir(config.dataset):
        return
    require_finished(one_dataset(Path(config.dataset)))
    if not is_dry and recipe.base_checkpoint:
        find_checkpoint(Path(recipe.base_checkpoint))


def run_folder_of(config: FinetuneConfig) -> Path:
    """Return the run folder of a fine-tuning."""
    if config.out is not None:
        return Path(config.out)
    return (
        Path("runs") / f"{Path(config.policy).stem}-{Path(config.dataset).resolve().name}-{config.run_seed}"
    )


def compared_fields(recipe: FinetuneRecipe | AgentRecipe) -> dict[str, Any]:  # Any: plain data
    """Return the recipe's fields that weights may depend on."""
    return {name: value for name, value in to_data(recipe).items() if name not in LOGGERS}


def request_sha256(recipe: FinetuneRecipe, dataset: Path, base_sha256: str | None, *, run_seed: int) -> str:
    """Return a digest of all that the weights depend on: recipe, seed, base, dataset's facts."""
    files = [dataset / kind.file for kind in KINDS]  # digests of all others
    facts = [file_sha256(file) for file in files if file.is_file()]
    return digest_of([compared_fields(recipe), run_seed, facts, dataset.resolve().name, base_sha256])


def finished_run(config: FinetuneConfig) -> FinetuneSummary | None:
    """Return the run that a configuration asks for if it is finished; None: look closer."""
    recipe, out = load_finetune_recipe(config).value, run_folder_of(config)
    step = newest_step(out)
    if step != recipe.steps:
        return None
    record = read_record(out)
    dataset = one_dataset(Path(config.dataset))
    base = checkpoint_sha256(Path(recipe.base_checkpoint)) if recipe.base_checkpoint else None
    if record.get(REQUEST_KEY) != request_sha256(recipe, dataset, base, run_seed=config.run_seed):
        return None
    if config.held_out is not None:
        tasks = record.get("tasks")
        task = config.held_out.task or (tasks[0] if isinstance(tasks, list) and len(tasks) == 1 else "")
        if not task:
            return None
        task = task_spec(str(task)).id
        held_out = HeldOut(settings=config.held_out, task=task, out=out, last_step=step)  # only looked for
        if held_out.missing(read_metrics(out)):
            return None
    return FinetuneSummary(out=out, step=step, is_finished=True)
