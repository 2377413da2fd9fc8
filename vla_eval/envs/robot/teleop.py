"""LeRobot's teleoperator, read in the numbers of the arm that it leads; its errors become `RobotError`s."""

from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval.control_modes import POSITION
from vla_eval.envs.robot.link import Motors, RobotLink, device_errors
from vla_eval.errors import RecipeError, RobotBusError, RobotError

KIND = "teleoperator"
DEGREES = "use_degrees"  # LeRobot's field: degrees, or -100 to 100


class TeleopLink:
    """A LeRobot teleoperator whose action is a position of each motor of the arm, as a leader arm's is."""

    def __init__(self, teleop: Any, robot: RobotLink) -> None:
        """Compare it with the arm; nothing is connected.

        Raises:
            RobotError: it does not give positions of just the arm's motors.
            RecipeError: its numbers are others than the arm's.
        """
        self.teleop, self.motors = teleop, robot.motors
        expected = {f"{name}{POSITION}" for name in robot.motors}
        found = set(teleop.action_features)
        if found != expected:
            raise RobotError(
                f"{KIND} '{teleop.name}': expected positions of the arm's motors "
                f"({', '.join(sorted(expected))}), found {', '.join(sorted(found)) or 'none'}. Use a leader "
                "arm with these motors."
            )
        configs = (teleop, robot.robot)
        units = [getattr(getattr(one, "config", None), DEGREES, None) for one in configs]
        if None not in units and units[0] != units[1]:
            raise RecipeError(
                f"teleop.{DEGREES} is {units[0]} and lerobot.{DEGREES} {units[1]}: the arm would be sent "
                "other numbers than the leader shows. Set both to the same."
            )

    def connect(self) -> None:
        """Connect; one without a calibration is refused, since its positions mean nothing."""
        with device_errors(KIND, self.teleop.name, "connecting"):
            self.teleop.connect(calibrate=False)
            is_calibrated = bool(self.teleop.is_calibrated)
        if not is_calibrated:
            raise RobotBusError(
                f"{KIND} '{self.teleop.name}': it is not calibrated. Run LeRobot's `lerobot-calibrate` with "
                "the same `type`, `port` and `id`."
            )

    def disconnect(self) -> None:
        """Disconnect."""
        if self.teleop.is_connected:
            with device_errors(KIND, self.teleop.name, "disconnecting"):
                self.teleop.disconnect()

    def read(self) -> Motors:
        """Return where it is; raise if a motor is missing, or not finite."""
        with device_errors(KIND, self.teleop.name, "reading"):
            found = self.teleop.get_action()
        values = [found.get(f"{name}{POSITION}") for name in self.motors]
        for name, value in zip(self.motors, values, strict=True):
            if value is None or not np.isfinite(value):
                raise RobotBusError(
                    f"{KIND} '{self.teleop.name}': expected a position of the motor '{name}', found {value}. "
                    "Check its cable and its id."
                )
        return np.array(values, dtype=np.float64)
