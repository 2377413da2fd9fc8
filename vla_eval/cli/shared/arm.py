"""Connect an arm, what leads it, and somebody beside it, for the verbs that drive one."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vla_eval.config.real_robot import TYPE, RobotSettings, load_robot
from vla_eval.errors import RecipeError, check_names

if TYPE_CHECKING:
    from vla_eval.envs.robot.operators import Operator
    from vla_eval.envs.robot.robot_env import Station
    from vla_eval.real.leaders import Leader

KEYS, SCRIPTED, LEROBOT = "keys", "scripted", "lerobot"


@dataclass(frozen=True, slots=True, kw_only=True)
class Connecting:
    """How an arm is connected."""

    settings: RobotSettings
    stops: Callable[[], bool]
    faults: dict[int, str] = field(default_factory=dict)  # number of an episode -> what goes wrong in it


def named_robot(name: str, operator: str | None) -> RobotSettings:
    """Return the arm of `--robot`, with whom `--operator` names beside it."""
    robot = load_robot(name)
    chosen = operator or (SCRIPTED if robot.is_simulated else KEYS)
    if (chosen == SCRIPTED) != robot.is_simulated:
        raise RecipeError(
            f"--operator {chosen}: a script sets the table of the simulated arm (--robot simulated_so100), "
            "and a person that of a real one. Leave --operator out."
        )
    return robot


def named_leader(robot: RobotSettings, teleop: str | None) -> str:
    """Return what leads the arm, as a recording calls it: LeRobot's type, or `scripted`."""
    chosen = teleop or (SCRIPTED if robot.is_simulated else LEROBOT)
    if (chosen == SCRIPTED) != robot.is_simulated:
        raise RecipeError(
            f"--teleop {chosen}: a script leads the simulated arm (--robot simulated_so100), and a "
            "teleoperator of LeRobot's a real one. Leave --teleop out."
        )
    if robot.is_simulated:
        return SCRIPTED
    if robot.teleop is None:
        raise RecipeError(
            "`teleop` is missing in the arm's file: what leads the arm, with LeRobot's fields, for example "
            "`teleop: {type: so101_leader, port: /dev/ttyACM1, id: leader}`."
        )
    return str(robot.teleop[TYPE])


def named_faults(texts: list[str], robot: RobotSettings, *, n_episodes: int) -> dict[int, str]:
    """Return number of an episode -> fault, of `--rehearse`."""
    if texts and not robot.is_simulated:
        raise RecipeError("--rehearse: expected --robot simulated_so100: a real arm has faults of its own.")
    found = {}
    for text in texts:
        kind, _, number = text.partition("@")
        check_names("fault", [kind], fault_names(), where="--rehearse")
        if not (number.isascii() and number.isdigit() and 1 <= int(number) <= n_episodes):
            raise RecipeError(
                f"--rehearse {text:.200}: expected FAULT@N with an episode from 1 to {n_episodes}, for "
                "example cable@2."
            )
        found[int(number)] = kind
    return found


def fault_names() -> tuple[str, ...]:
    """Return what can be rehearsed."""
    from vla_eval.envs.robot.faults import FAULTS

    return tuple(FAULTS)


@contextmanager
def connected(asked: Connecting) -> "Iterator[Station]":
    """Connect the arm, and have somebody beside it."""
    from vla_eval.envs.robot.link import RobotLink
    from vla_eval.envs.robot.opening import open_robot
    from vla_eval.envs.robot.robot_env import Station
    from vla_eval.envs.robot.units import Units
    from vla_eval.envs.robot.watch import StepClock, WallClock

    settings = asked.settings
    with ExitStack() as ending:
        device = open_robot(settings)
        link = RobotLink(device)
        Units.of(settings, link.motors)  # refuses limits of motors that are not there, before it connects
        clock = StepClock() if settings.is_simulated else WallClock()
        operator = _operator(asked, device, clock, ending)
        ending.callback(link.disconnect)
        link.connect()
        yield Station.beside(link, operator, settings, clock)


@contextmanager
def led(station: "Station") -> "Iterator[tuple[Station, Leader]]":
    """Connect what leads the arm; the operator of the station that is returned hears of it."""
    import dataclasses

    from vla_eval.envs.robot.opening import open_teleop
    from vla_eval.envs.robot.teleop import TeleopLink
    from vla_eval.real.leaders import BesideLeader, ScriptedLeader, TeleopLeader

    fields = station.settings.teleop
    if fields is None:
        yield station, ScriptedLeader()
        return
    link = TeleopLink(open_teleop(fields), station.link)
    with ExitStack() as ending:
        ending.callback(link.disconnect)
        link.connect()
        operator = BesideLeader(station.operator, station, link)
        yield dataclasses.replace(station, operator=operator), TeleopLeader(link)


def say(line: str) -> None:
    """Show a line to the operator."""
    print(line, file=sys.stderr, flush=True)


def _operator(
    asked: Connecting, device: Any, clock: Any, ending: ExitStack
) -> "Operator":  # Any: a robot of lerobot's, and a clock
    if asked.settings.is_simulated:
        from vla_eval.envs.robot.scripted import ScriptedOperator

        device.faults.update(asked.faults)
        ending.callback(device.close)
        return ScriptedOperator(device)
    from vla_eval.envs.robot.keys import KeysOperator

    terminal = sys.stdin.fileno()
    keys = KeysOperator(asked.settings, clock, descriptor=terminal, say=say, stops=asked.stops)
    return ending.enter_context(keys)
