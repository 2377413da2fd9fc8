"""From a recipe to what is recorded of each task; finds mistakes before a simulator is started."""

from dataclasses import dataclass

from vla_eval.checkpoints.notes import checkpoint_hashes
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import Recipe, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.prompts import load_prompts, sentences_of
from vla_eval.data.recording.demonstrations import ONE_BY_ONE
from vla_eval.data.recording.encoder_check import check_encoder
from vla_eval.data.recording.jobs import TaskPlan
from vla_eval.envs.factory import describe_env
from vla_eval.evaluation.episode_jobs import EpisodeGroup, GroupKey
from vla_eval.policies.registry import check_adapter
from vla_eval.rollout import RolloutSettings
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.spec import TaskSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingPlan:
    """What is recorded of each task, and the digests of recipes, prompts and weights."""

    tasks: tuple[TaskPlan, ...]
    recipe_files: dict[str, str]


def plan_recording(recipe: DatasetRecipe) -> RecordingPlan:
    """Find what can be wrong with a recipe before a simulator is started.

    Raises:
        UnknownNameError: a task, expert or prompt set does not exist.
        RecipeError: the expert's recipe is wrong, or the video encoder refuses its settings.
        MissingInstructionError: a task has no instruction.
        TaskArgumentError: see `describe_env`.
        CheckpointError: the expert's weights are not there.
    """
    check_encoder(recipe.encoder)
    expert = load_recipe("policies", recipe.expert, PolicyRecipe)
    check_adapter(expert.value.adapter)
    prompts = load_prompts(recipe.prompt_set)
    specs = [task_spec(task) for task in recipe.tasks]
    return RecordingPlan(
        tasks=tuple(_task_plan(recipe, expert, spec, sentences_of(prompts, spec)[0]) for spec in specs),
        recipe_files={
            f"policies/{expert.name}": expert.sha256,
            f"prompts/{prompts.name}": prompts.sha256,
            **checkpoint_hashes(expert.value.adapter, expert.value.args, policy=expert.name),
        },
    )


def _task_plan(
    recipe: DatasetRecipe, expert: Recipe[PolicyRecipe], spec: TaskSpec, instruction: str
) -> TaskPlan:
    env = EnvSettings(task=spec.id, kwargs=recipe.env, simulator=recipe.simulator, render=recipe.render)
    describe_env(env)
    return TaskPlan(
        group=EpisodeGroup(
            key=GroupKey(spec.id, expert.name, 1),
            adapter=expert.value.adapter,
            args=expert.value.args,
            env=env,
            rollout=RolloutSettings(
                chunking=ONE_BY_ONE,
                stop_at_success=recipe.cut == "after_success",
                steps_after_success=recipe.steps_after_success,
            ),
            instruction=instruction,
        ),
        task_version=spec.version,
        expert_version=expert.value.version,
        recipe=recipe,
    )
