"""Register our simulated tasks with Gymnasium, as `vla_eval/<id>` and `vla_eval_maniskill/<id>`.

`import vla_eval.tasks.register`, then `gymnasium.make("vla_eval/RememberColor3-v0")` runs one episode at a
time, in numpy, as an evaluation does; `vla_eval_maniskill/…` is ManiSkill's environment: batched, torch. Of a
suite with a namespace of its own they are `real_twin/…` and `real_twin_maniskill/…`.
"""

import functools
import importlib
from typing import Any

import gymnasium as gym
import torch
from mani_skill.utils import registration

from vla_eval.config.prompts import instruction_for
from vla_eval.errors import MissingDependencyError
from vla_eval.tasks.catalog import SUITES, TASKS
from vla_eval.tasks.spec import TaskSpec

MAKE = "vla_eval.envs.gymnasium_env:make_env"
"""Text, as Gymnasium imports it when it is first called: tasks know nothing of what runs them."""


def env_class(spec: TaskSpec) -> Any:  # a ManiSkill class; ManiSkill is untyped
    """Import and return the class behind a row of the catalogue."""
    module, _, name = spec.entry_point.partition(":")
    return getattr(importlib.import_module(module), name)


def register_all() -> None:
    """Register what is not registered yet."""
    for spec in (*TASKS.values(), *SUITES["real_twin"].values()):
        if spec.maniskill_id not in registration.REGISTERED_ENVS:
            gym.register(spec.gym_id, entry_point=MAKE, kwargs={"task": spec.id})
            kwargs = {key: list(v) if isinstance(v, tuple) else v for key, v in spec.kwargs.items()}
            kwargs["instruction"] = instruction_for(spec)
            register = registration.register_env(
                spec.maniskill_id, max_episode_steps=spec.horizon_steps, **kwargs
            )
            register(env_class(spec))
            gym.registry[spec.maniskill_id].entry_point = functools.partial(_make_maniskill, spec)


def _make_maniskill(spec: TaskSpec, **arguments: Any) -> Any:
    """Return ManiSkill's environment, or say what to do where it would not find a GPU."""
    n_envs = arguments.get("num_envs", 1)
    if n_envs > 1 and not torch.cuda.is_available():
        raise MissingDependencyError(
            f"{spec.maniskill_id}: num_envs={n_envs}: several episodes in one environment need a GPU, and "
            f"none was found. On a CPU: {spec.make_vec(n_envs=n_envs)}. See docs/gymnasium.md."
        )
    return registration.make(spec.maniskill_id, **arguments)


register_all()
