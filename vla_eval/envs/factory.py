"""Make an environment from its settings: alone knows which simulators exist, imports them on first use."""

import importlib
from typing import cast, get_args

from vla_eval.config.environment import EnvSettings, Simulator
from vla_eval.core import SimEnv
from vla_eval.envs.fake import FakeEnv
from vla_eval.envs.official_settings import check_official
from vla_eval.errors import MissingDependencyError, check_names
from vla_eval.lock.switch import own_need
from vla_eval.specs import EnvSpec
from vla_eval.tasks.arguments import check_arguments, offered_by, robot_uid
from vla_eval.tasks.catalog import task_spec

OURS, OFFICIAL = "vla_eval.envs.maniskill:ManiSkillEnv", "vla_eval.envs.official:OfficialEnv"
"""What runs our tasks on ManiSkill; those of the official package are its own ManiSkill environments."""


def make_env(settings: EnvSettings) -> SimEnv:
    """Make the environment that the settings describe.

    Raises:
        MissingDependencyError: the simulator is not installed.
        TaskArgumentError: the task does not take these arguments.
        RenderingError: cameras are wanted and no renderer can be started.
    """
    check_names("simulator", [settings.simulator], get_args(Simulator))
    if settings.simulator == "fake":
        return FakeEnv(settings)
    place = OFFICIAL if task_spec(settings.task).is_official else OURS
    module_name, _, attribute = place.partition(":")
    try:
        with own_need():  # SAPIEN runs a program when it is imported
            module = importlib.import_module(module_name)
    except ModuleNotFoundError as exc:
        if exc.name is None or exc.name.split(".")[0] == "vla_eval":
            raise
        raise MissingDependencyError(
            f"simulator '{settings.simulator}' needs the package '{exc.name}', which is not installed. "
            f"Run `make setup`, or install mikasa-vla-eval again; `mikasa-vla doctor` checks the machine."
        ) from exc
    return cast("SimEnv", getattr(module, attribute)(settings))


def describe_env(settings: EnvSettings) -> EnvSpec:
    """Return what the environment of these settings offers to a policy, without starting a simulator.

    Raises:
        TaskArgumentError: the task does not take these arguments, or not together.
        UnknownNameError: there is no such argument, arm or control mode.
    """
    if settings.simulator == "fake":
        return FakeEnv(settings).spec  # arrays only
    task = task_spec(settings.task)
    if task.is_official:
        check_official(settings, task)
    else:
        check_arguments(task, settings.kwargs)
        robot_uid(settings.kwargs, wrist_mesh=settings.render.wrist_mesh)
    return offered_by(task, settings.kwargs)


def describe_device(env: SimEnv) -> dict[str, str]:
    """Return the environment's `device` (name of the render device, driver …), or nothing if it has none.

    It is written into the run folder, because images may differ between devices.
    """
    return dict(getattr(env, "device", None) or {})
