"""LeRobot's teleoperator, read in the numbers of the arm that it leads; its errors become `RobotError`s."""

from typing import Any  # lerobot is untyped

from vla_eval.control_modes import POSITION
from vla_eval.envs.robot.link import DeviceLink, Motors, RobotLink
from vla_eval.errors import RecipeError, RobotError

DEGREES = "use_degrees"  # LeRobot's field: degrees, or -100 to 100


class TeleopLink(DeviceLink):
    """A LeRobot teleoperator whose action is a position of each motor of the arm, as a leader arm's is."""

    kind = "teleoperator"

    def __init__(self, teleop: Any, robot: RobotLink) -> None:
        """Compare it with the arm; nothing is connected.

        Raises:
            RobotError: it does not give positions of just the arm's motors.
            RecipeError: its numbers are others than the arm's.
        """
        super().__init__(teleop)
        self.motors = robot.motors
        expected = {f"{name}{POSITION}" for name in robot.motors}
        found = set(teleop.action_features)
        if found != expected:
            raise RobotError(
                f"{self.kind} '{teleop.name}': expected positions of the arm's motors "
                f"({', '.join(sorted(expected))}), found {', '.join(sorted(found)) or 'none'}. Use a leader "
                "arm with these motors."
            )
        configs = (teleop, robot.device)
        units = [getattr(getattr(one, "config", None), DEGREES, None) for one in configs]
        if None not in units and units[0] != units[1]:
            raise RecipeError(
                f"teleop.{DEGREES} is {units[0]} and lerobot.{DEGREES} {units[1]}: the arm would be sent "
                "other numbers than the leader shows. Set both to the same."
            )

    def read(self) -> Motors:
        """Return where it is; raise if a motor is missing, or not finite."""
        with self.errors("reading"):
            found = self.device.get_action()
        return self.positions(found)
