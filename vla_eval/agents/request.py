"""What a training by rewards is asked for, and whether its folder has all of it. Waits for no torch."""

import math
from dataclasses import replace
from pathlib import Path

from vla_eval.config.agents import AgentConfig, AgentRecipe
from vla_eval.config.files import Recipe, digest_of
from vla_eval.config.policy import changed_section, load_policy
from vla_eval.errors import RecipeError
from vla_eval.policies.agents.algorithms import Algorithm, algorithm, steps_per_update
from vla_eval.tasks.arguments import check_arguments, pinned
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.training.request import FinetuneSummary, compared_fields
from vla_eval.training.run_folder import REQUEST_KEY, newest_step, read_record


def load_agent_recipe(config: AgentConfig) -> Recipe[AgentRecipe]:
    """Return the recipe's section, with the configuration's values on top."""
    recipe = load_policy(config.policy)
    if recipe.value.train_agent is None:
        raise RecipeError(
            f"policies/{recipe.name}.yaml has no section `train_agent`: it is not trained by rewards. "
            f"`mikasa-vla list policies` shows the recipes; `finetune` trains on demonstrations."
        )
    return changed_section(recipe, "train_agent", AgentRecipe, config.train_agent)


def look_for(config: AgentConfig) -> FinetuneSummary | None:
    """Look for task and recipe, before torch is loaded; return the run if it is finished.

    With held-out evaluations it may not have all of them: then it is looked at more closely.
    """
    recipe, task = load_agent_recipe(config).value, task_spec(config.task)
    row = algorithm(recipe.algorithm)
    if not task.is_base:
        check_arguments(task, recipe.env)
    out = run_folder_of(config)
    step = newest_step(out)
    if config.held_out is not None or step == 0:
        return None
    recipe = in_whole_updates(replace(recipe, env=without_path(pinned(recipe.env, [task]))), row)
    asked = request_sha256(recipe, task.id, run_seed=config.run_seed)
    if step != recipe.steps or read_record(out).get(REQUEST_KEY) != asked:
        return None
    return FinetuneSummary(out=out, step=step, is_finished=True)


def run_folder_of(config: AgentConfig) -> Path:
    """Return the run folder of a training."""
    if config.out is not None:
        return Path(config.out)
    name = task_spec(config.task).id.replace("/", "-")
    return Path("runs") / f"{config.label or Path(config.policy).stem}-{name}-{config.run_seed}"


def request_sha256(recipe: AgentRecipe, task: str, *, run_seed: int) -> str:
    """Return a digest of all that the weights depend on."""
    return digest_of([compared_fields(recipe), task, run_seed])


def in_whole_updates(recipe: AgentRecipe, row: Algorithm) -> AgentRecipe:
    """Return it with steps in whole updates: the library does no half ones."""
    unit = steps_per_update(row, recipe.arguments, n_envs=recipe.n_envs)
    save = rounded_up(recipe.save_every_steps, unit)
    return replace(recipe, steps=rounded_up(recipe.steps, unit), save_every_steps=save)


def rounded_up(number: int, unit: int) -> int:
    """Return the least multiple of the unit that is not below the number."""
    return math.ceil(number / unit) * unit
