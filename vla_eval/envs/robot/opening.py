"""Make LeRobot's robot from its fields. Alone knows LeRobot's registries."""

import importlib
import logging
import pkgutil
from collections.abc import Mapping
from types import ModuleType
from typing import Any  # lerobot is untyped

from vla_eval.config.real_robot import TYPE, RobotSettings
from vla_eval.errors import MissingDependencyError, RecipeError, unknown_name
from vla_eval.lock.switch import let_everything, own_need

EXTRA = "mikasa-vla-eval[real]"

logger = logging.getLogger(__name__)


def open_robot(settings: RobotSettings) -> Any:
    """Return the robot, not connected.

    Raises:
        UnknownNameError: LeRobot and its plug-ins have no such robot.
        RecipeError: LeRobot does not take these fields.
        MissingDependencyError: its driver is not installed.
    """
    with own_need():
        simulated = importlib.import_module("vla_eval.envs.robot.simulated")  # registers it
    if settings.is_simulated:
        return simulated.SimulatedSO100(_config(settings.lerobot))
    let_everything(f"{settings.type} is a device: its drivers open ports and cameras")
    _register()
    config, robots = _config(settings.lerobot), importlib.import_module("lerobot.robots")
    try:
        return robots.make_robot_from_config(config)
    except ImportError as exc:
        raise MissingDependencyError(
            f"robot '{settings.type}': its driver is not installed ({exc}). Run: pip install '{EXTRA}'"
        ) from exc


def _config(fields: Mapping[str, Any]) -> Any:
    """Return LeRobot's configuration of these fields."""
    draccus = importlib.import_module("draccus")
    robot_config = importlib.import_module("lerobot.robots.config").RobotConfig
    known = robot_config.get_known_choices()
    if fields[TYPE] not in known:
        raise unknown_name("robot", str(fields[TYPE]), known, where="lerobot.type")
    try:
        return draccus.decode(robot_config, dict(fields))
    except Exception as exc:  # draccus and LeRobot's checks raise many kinds
        raise RecipeError(
            f"lerobot: LeRobot does not take these fields of '{fields[TYPE]}': {exc} See its documentation "
            "of this robot."
        ) from exc


def _register() -> None:
    """Import LeRobot's robots and cameras, and its plug-ins: each registers its own type."""
    for name in ("lerobot.robots", "lerobot.cameras"):
        _import_below(importlib.import_module(name))
    importlib.import_module("lerobot.utils.import_utils").register_third_party_plugins()


def _import_below(package: ModuleType) -> None:
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        if not module.ispkg:
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as exc:  # of a robot whose driver is missing; another one may be wanted
            logger.debug("%s cannot be imported: %s", module.name, exc)
