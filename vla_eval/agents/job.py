"""One training by rewards, resolved once: all that can be refused is refused before the run has a folder."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from vla_eval.agents.request import in_whole_updates, load_agent_recipe, rounded_up, run_folder_of
from vla_eval.base_tasks.named import DISCRETE
from vla_eval.config.agents import TRAINING_SEEDS, AgentConfig, AgentRecipe
from vla_eval.config.dataset import EVALUATION_SEEDS
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import HeldOutConfig
from vla_eval.control_modes import CONTROL_MODE
from vla_eval.envs.factory import describe_env
from vla_eval.errors import RecipeError
from vla_eval.policies.agents.algorithms import (
    Algorithm,
    algorithm,
    check_arguments,
    network_fields,
    steps_per_update,
)
from vla_eval.policies.agents.imitator import NETWORK, CoreSizes
from vla_eval.policies.agents.observing import Reader, reader_of
from vla_eval.policies.lerobot.device import choose_device
from vla_eval.specs import EnvSpec
from vla_eval.strict.decoding import decode
from vla_eval.strict.devices import refuse_missing_gpu
from vla_eval.tasks.arguments import pinned
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.mesh_folder import without_path

ROBOTS_ALONE = {"action_noise": "arm to push", "exchange_share": "candidates that could be exchanged"}
"""Argument of an imitation -> what a task of MIKASA-Base lacks for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentJob:
    """One training."""

    name: str
    recipe_sha256: str
    recipe: AgentRecipe  # with the configuration's values on top, steps in whole updates
    asked_steps: int
    algorithm: Algorithm
    task: str
    settings: EnvSettings
    env: EnvSpec
    reader: Reader
    device: str
    out: Path
    run_seed: int
    held_out: HeldOutConfig | None
    workers: int | Literal["auto"] = "auto"
    resume_from: Path | None = None

    @property
    def first_step(self) -> int:
        """Steps that are done."""
        return 0 if self.resume_from is None else int(self.resume_from.name)

    @property
    def steps_per_update(self) -> int:
        """Steps of all environments together between two changes of the weights."""
        return steps_per_update(self.algorithm, self.recipe.arguments, n_envs=self.recipe.n_envs)


def agent_job(config: AgentConfig) -> AgentJob:
    """Return the training that a configuration asks for, from its beginning.

    Raises:
        VlaEvalError: algorithm, task, observation and reward do not fit each other.
    """
    loaded, task = load_agent_recipe(config), task_spec(config.task)
    row = algorithm(loaded.value.algorithm)
    check_arguments(row, loaded.value.arguments)
    network_fields(row, loaded.value.network)
    recipe = in_whole_updates(loaded.value, row)
    arguments = pinned(recipe.env, [task])
    recipe = replace(recipe, env=without_path(arguments))
    settings = EnvSettings(
        task=task.id,
        kwargs=_without_arm(arguments) if task.is_base else arguments,
        simulator=recipe.simulator,
        sim_backend=recipe.sim_backend,
        n_slots=recipe.n_envs,
    )
    if settings.simulator != "fake":
        refuse_missing_gpu(torch.cuda.device_count(), {"train_agent.sim_backend": settings.sim_backend})
    env = describe_env(settings)
    if not row.fits_discrete and env.action.control_mode == DISCRETE:
        raise RecipeError(
            f"algorithm '{row.name}' needs actions that are numbers; those of {task.id} are choices. "
            "Take ppo or ppo_lstm."
        )
    reader = reader_of(env, recipe.observation, n_candidates=task.n_candidates(settings.kwargs))
    if row.imitates:
        _check_imitation(recipe, reader, is_base=task.is_base)
    if task.is_base and recipe.reward == "sparse":
        raise RecipeError(f"--reward sparse: {task.id} has one reward, its own. Leave it out.")
    held_out = None if config.held_out is None else _checked_held_out(config.held_out, settings, recipe)
    return AgentJob(
        name=loaded.name,
        recipe_sha256=loaded.sha256,
        recipe=recipe,
        asked_steps=loaded.value.steps,
        algorithm=row,
        task=task.id,
        # the expert that is imitated reads true states
        settings=replace(settings, cameras=reader.cameras, privileged=reader.privileged or row.imitates),
        env=env,
        reader=reader,
        device=_device(config.device, reader),
        out=run_folder_of(config),
        run_seed=config.run_seed,
        held_out=held_out,
        workers=config.workers,
    )


def _check_imitation(recipe: AgentRecipe, reader: Reader, *, is_base: bool) -> None:
    """Refuse what no imitation can do."""
    decode(CoreSizes, recipe.network, where=NETWORK)
    if reader.cameras:
        raise RecipeError(
            "algorithm 'imitation' reads numbers, and is given images. Robot tasks have --observation "
            "vector; networks that imitate from images are trained by `mikasa-vla finetune` "
            "(docs/sequence_policies.md)."
        )
    for name, missing in ROBOTS_ALONE.items():
        if is_base and (value := recipe.arguments.get(name, 0)) > 0:
            raise RecipeError(
                f"train_agent.arguments.{name} is {value:g}: tasks of MIKASA-Base have no {missing}. "
                "Leave it out."
            )
    if recipe.reward != "dense":
        raise RecipeError(f"--reward {recipe.reward}: an imitation learns from no reward. Leave it out.")


def _without_arm(env: Mapping[str, Any]) -> dict[str, Any]:  # Any: arguments of a task
    """Return the arguments without that of a robot: one recipe is for tasks of both kinds."""
    return {name: value for name, value in env.items() if name != CONTROL_MODE}


def _device(asked: str, reader: Reader) -> str:
    """Return where it computes; `auto`: small networks of numbers are faster on a CPU."""
    return "cpu" if asked == "auto" and not reader.cameras else choose_device(asked)


def _checked_held_out(settings: HeldOutConfig, env: EnvSettings, recipe: AgentRecipe) -> HeldOutConfig:
    """Return when and on what checkpoints are evaluated: on the training's own task."""
    last = settings.seed_start + settings.episodes - 1
    if settings.seed_start <= EVALUATION_SEEDS[-1] or last >= TRAINING_SEEDS[0]:
        raise RecipeError(
            f"held_out.seed_start={settings.seed_start}, episodes={settings.episodes}: expected seeds above "
            f"{EVALUATION_SEEDS[-1]}, which tables are made from, and below {TRAINING_SEEDS[0]:,}, from "
            "where on the training's are."
        )
    _refuse_other(settings)
    every = rounded_up(settings.every_steps, recipe.save_every_steps)
    return replace(settings, every_steps=every, env=dict(env.kwargs), task=env.task, simulator=env.simulator)


def _refuse_other(settings: HeldOutConfig) -> None:
    given: Mapping[str, object] = {"task": settings.task, "env": settings.env or None}
    for name, value in given.items():
        if value is not None:
            raise RecipeError(
                f"held_out.{name}: an agent is evaluated in the environment that it is trained in. Leave it "
                "out; `mikasa-vla eval` evaluates a checkpoint elsewhere."
            )
