"""Make an environment from its settings: alone knows which simulators exist, imports them on first use."""

import importlib
from collections.abc import Iterable, Mapping
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
from vla_eval.tasks.spec import Suite

OWN, OFFICIAL = "vla_eval.envs.maniskill:ManiSkillEnv", "vla_eval.envs.official:OfficialEnv"
ENVIRONMENTS: Mapping[Suite, str] = {
    "paper": OWN,
    "objects": OWN,
    "real_twin": OWN,
    "mikasa_vla_90": OFFICIAL,
    "mikasa_official": OFFICIAL,
    "mikasa_base": "vla_eval.envs.mikasa_base:BaseTaskSim",
}
"""What runs the tasks of a suite."""


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
    module_name, _, attribute = ENVIRONMENTS[task_spec(settings.task).suite].partition(":")
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


def slow_modules(environments: Iterable[EnvSettings]) -> tuple[str, ...]:
    """Return what workers that run these environments need and what takes long to import."""
    places = (ENVIRONMENTS[task_spec(one.task).suite] for one in environments if one.simulator != "fake")
    return tuple(dict.fromkeys(place.partition(":")[0] for place in places))


def describe_env(settings: EnvSettings) -> EnvSpec:
    """Return what the environment of these settings offers to a policy, without starting a simulator.

    Raises:
        TaskArgumentError: the task does not take these arguments, or not together.
        UnknownNameError: there is no such argument, arm or control mode.
    """
    if settings.simulator == "fake":
        return FakeEnv(settings).spec  # arrays only
    task = task_spec(settings.task)
    if task.is_base:
        from vla_eval.envs.mikasa_base import describe_base  # imports gymnasium

        return describe_base(settings)
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
