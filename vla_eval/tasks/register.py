"""Register every task of the catalogue with Gymnasium and ManiSkill, as `vla_eval/<id>`.

`import vla_eval.tasks.register`, then `gymnasium.make("vla_eval/RememberColor3-v0", …)`.
"""

import importlib
from typing import Any

from mani_skill.utils.registration import REGISTERED_ENVS, register_env

from vla_eval.config.prompts import instruction_for
from vla_eval.tasks.catalog import TASKS
from vla_eval.tasks.spec import TaskSpec


def env_class(spec: TaskSpec) -> Any:  # a ManiSkill class; ManiSkill is untyped
    """Import and return the class behind a row of the catalogue."""
    module, _, name = spec.entry_point.partition(":")
    return getattr(importlib.import_module(module), name)


def register_all() -> None:
    """Register what is not registered yet."""
    for spec in TASKS.values():
        if spec.gym_id not in REGISTERED_ENVS:
            kwargs = {key: list(v) if isinstance(v, tuple) else v for key, v in spec.kwargs.items()}
            kwargs["instruction"] = instruction_for(spec)
            register_env(spec.gym_id, max_episode_steps=spec.horizon_steps, **kwargs)(env_class(spec))


register_all()
