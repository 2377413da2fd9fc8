"""Several trainings of agents in one call, of each recipe, task and run seed, and the evaluation of all."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from vla_eval.agents.request import load_agent_recipe, run_folder_of
from vla_eval.config.agents import AgentConfig
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import RecipeError
from vla_eval.storage.durable import replace_file
from vla_eval.storage.shard import Shard
from vla_eval.strict.decoding import decode
from vla_eval.tasks.catalog import task_spec

EVALUATION_FILE = "eval.yaml"
EPISODES = 100
CONTROLS = {True: ("random", "memoryless", "oracle"), False: ("random", "cue_blind", "oracle")}
"""Of MIKASA-Base, and of a robot's tasks."""


def in_folders(configs: Sequence[AgentConfig], out: Path) -> list[AgentConfig]:
    """Return the trainings, each with a folder of its own in `out`.

    Raises:
        RecipeError: two are the same, or they cannot be evaluated together.
    """
    placed = [replace(one, out=str(out / run_folder_of(replace(one, out=None)).name)) for one in configs]
    folders = [one.out for one in placed]
    double = next((folder for folder in folders if folders.count(folder) > 1), None)
    if double is not None:
        raise RecipeError(
            f"{double}: two of these trainings are the same. Name each task, recipe and seed once."
        )
    evaluation(placed)  # refuses what does not go together
    return placed


def of_shard(configs: Sequence[AgentConfig], shard: Shard | None) -> list[AgentConfig]:
    """Return those of a shard: with I/N, every N-th."""
    if shard is None:
        return list(configs)
    return list(configs[shard.number - 1 :: shard.count])


def evaluation(configs: Sequence[AgentConfig]) -> EvalConfig:
    """Return the evaluation of the trainings beside their controls: a run per run seed."""
    return decode(EvalConfig, _evaluation(configs), where="trainings")


def write_evaluation(configs: Sequence[AgentConfig], out: Path) -> Path:
    """Write the evaluation as a configuration, and return the file."""
    file = out / EVALUATION_FILE
    replace_file(file, yaml.safe_dump(_evaluation(configs), sort_keys=False, allow_unicode=True))
    return file


def _evaluation(configs: Sequence[AgentConfig]) -> dict[str, Any]:  # Any: plain data of YAML
    """Return it as a person would write it: defaults are left out."""
    recipes = [load_agent_recipe(one).value for one in configs]
    tasks = list(dict.fromkeys(task_spec(one.task).id for one in configs))
    kinds = {task_spec(task).is_base for task in tasks}
    if len(kinds) > 1:
        raise RecipeError(
            "--task: tasks of MIKASA-Base and of a robot cannot be evaluated together. Train them in two "
            "calls."
        )
    env: dict[str, Any] = {} if True in kinds else recipes[0].env
    if not all(one.env == recipes[0].env for one in recipes) and False in kinds:
        raise RecipeError(
            f"train_agent.env: expected the same for all recipes, found "
            f"{[one.env for one in recipes]}. Give it with --set env.…, or train them in several calls."
        )
    runs: dict[tuple[str, str], list[str]] = {}
    for one in configs:
        name = one.label or Path(one.policy).stem.removesuffix("_base")
        runs.setdefault((name, task_spec(one.task).id), []).append(str(one.out))
    policies = [f"{name}:{task}={','.join(folders)}" for (name, task), folders in runs.items()]
    simulator = recipes[0].simulator
    return {
        "name": "agents",
        "tasks": tasks,
        "policies": [*policies, *CONTROLS[True in kinds]],
        "episodes": EPISODES,
        **({"env": dict(env)} if env else {}),
        **({} if simulator == "maniskill" else {"simulator": simulator}),
    }
