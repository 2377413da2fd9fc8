"""Make LeRobot's robot and teleoperator from their fields. Alone knows LeRobot's registries."""

import importlib
import logging
import pkgutil
from collections.abc import Mapping
from types import ModuleType
from typing import Any, NamedTuple  # Any: lerobot is untyped

from vla_eval.config.real_robot import TYPE, RobotSettings
from vla_eval.errors import MissingDependencyError, RecipeError, unknown_name
from vla_eval.lock.switch import let_everything, own_need

EXTRA = "mikasa-vla-eval[real]"


class DeviceKind(NamedTuple):
    """A kind of LeRobot's devices: its word, its field in a file, its module, configuration and factory."""

    word: str
    field: str
    module: str
    config: str
    make: str


ROBOT = DeviceKind("robot", "lerobot", "lerobot.robots", "RobotConfig", "make_robot_from_config")
TELEOP = DeviceKind(
    "teleoperator",
    "teleop",
    "lerobot.teleoperators",
    "TeleoperatorConfig",
    "make_teleoperator_from_config",
)

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
    return _device(ROBOT, settings.lerobot)


def open_teleop(fields: Mapping[str, Any]) -> Any:
    """Return the teleoperator of LeRobot's fields, not connected; errors as `open_robot`."""
    return _device(TELEOP, fields)


def _device(kind: DeviceKind, fields: Mapping[str, Any]) -> Any:
    let_everything(f"{fields[TYPE]} is a device: its drivers open ports and cameras")
    _register()
    config, module = _config(fields, kind), importlib.import_module(kind.module)
    try:
        return getattr(module, kind.make)(config)
    except ImportError as exc:
        raise MissingDependencyError(
            f"{kind.word} '{fields[TYPE]}': its driver is not installed ({exc}). Run: pip install '{EXTRA}'"
        ) from exc


def _config(fields: Mapping[str, Any], kind: DeviceKind = ROBOT) -> Any:
    """Return LeRobot's configuration of these fields."""
    draccus = importlib.import_module("draccus")
    config = getattr(importlib.import_module(f"{kind.module}.config"), kind.config)
    known = config.get_known_choices()
    if fields[TYPE] not in known:
        raise unknown_name(kind.word, str(fields[TYPE]), known, where=f"{kind.field}.type")
    try:
        return draccus.decode(config, dict(fields))
    except Exception as exc:  # draccus and LeRobot's checks raise many kinds
        raise RecipeError(
            f"{kind.field}: LeRobot does not take these fields of '{fields[TYPE]}': {exc} See its "
            f"documentation of this {kind.word}."
        ) from exc


def _register() -> None:
    """Import LeRobot's robots, leaders and cameras, and its plug-ins: each registers its own type."""
    for name in (ROBOT.module, TELEOP.module, "lerobot.cameras"):
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
