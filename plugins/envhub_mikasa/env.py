"""The tasks of mikasa-vla-eval for LeRobot's EnvHub. The environment itself is in that package.

The task is that of the configuration, else of the environment variable `MIKASA_TASK`, else
`RememberColor3-v0`; several have commas between them.
"""

import os
from dataclasses import fields
from typing import Any  # the values of a configuration

from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from lerobot.envs import HubEnvConfig

try:
    from vla_eval.errors import RecipeError, check_names
    from vla_eval.lerobot_plugin import MikasaEnvConfig
except ModuleNotFoundError as error:
    if error.name != "vla_eval":
        raise
    # LeRobot drops the message of a ModuleNotFoundError.
    raise ImportError(
        "vla_eval is not installed in this Python. Expected: the package mikasa-vla-eval, which contains the "
        "tasks. In a clone of its repository, `make setup` makes an environment that has it and LeRobot."
    ) from error

OF_LEROBOT = {field.name for field in fields(HubEnvConfig)} - {"task", "max_parallel_tasks"}
OURS = {field.name for field in fields(MikasaEnvConfig)} - OF_LEROBOT


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: HubEnvConfig | None = None
) -> dict[str, dict[int, VectorEnv[Any, Any, Any]]]:
    """Return `mikasa` -> number of the task -> vector of `n_envs` environments.

    Args:
        n_envs: episodes at a time.
        use_async_envs: a process per environment; one environment stays in this process.
        cfg: may have the fields of `MikasaEnvConfig`.

    Raises:
        RecipeError: `n_envs` is below 1.
        UnknownNameError: there is no such task, or no such field.
    """
    if n_envs < 1:
        raise RecipeError(f"n_envs is {n_envs}, expected at least 1.")
    fields_given = {} if cfg is None else vars(cfg)
    given = {name: value for name, value in fields_given.items() if name not in OF_LEROBOT}
    check_names("field of the environment", given, OURS, where=type(cfg).__name__)
    if given.get("task") is None:
        given["task"] = os.environ.get("MIKASA_TASK", "RememberColor3-v0")
    suites = MikasaEnvConfig(**given).create_envs(n_envs)  # simulators start at the first reset
    if not use_async_envs or n_envs == 1:
        return suites
    # Not LeRobot's own vector of processes: its `action_space` is that of one environment. Not a fork: a
    # forked process would inherit a simulator's threads and GPU.
    return {
        suite: {
            number: AsyncVectorEnv(vector.env_fns, context="spawn", autoreset_mode=AutoresetMode.NEXT_STEP)
            for number, vector in vectors.items()
        }
        for suite, vectors in suites.items()
    }
