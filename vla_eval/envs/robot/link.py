"""LeRobot's robot, read and commanded in its own numbers. Whatever it raises becomes a `RobotError`.

Knows nothing of policies, units of models, operators or time.
"""

import contextlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any  # lerobot is untyped

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import POSITION
from vla_eval.core import ImageArray
from vla_eval.errors import RobotBusError, RobotCameraError, RobotError
from vla_eval.specs import CameraSpec

CHANNELS = 3

Motors = NDArray[np.float64]
"""Positions of the motors in LeRobot's numbers, (M,): degrees, or 0 to 100 for a gripper."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What the robot reports now."""

    motors: Motors
    images: Mapping[str, ImageArray]  # camera -> (H, W, 3)


class DeviceLink:
    """A device of LeRobot's with motors: how it is connected, and how a position of them is read."""

    kind: str  # in messages
    motors: tuple[str, ...]

    def __init__(self, device: Any) -> None:
        """Take a device; nothing is connected."""
        self.device = device

    def connect(self) -> None:
        """Connect; one without a calibration is refused, since its positions mean nothing."""
        with self.errors("connecting"):
            self.device.connect(calibrate=False)
            is_calibrated = bool(self.device.is_calibrated)
        if not is_calibrated:
            raise RobotBusError(
                f"{self.kind} '{self.device.name}': it is not calibrated. Run LeRobot's `lerobot-calibrate` "
                "with the same `type`, `port` and `id`."
            )

    def reconnect(self) -> None:
        """Connect again after a fault."""
        try:
            self.disconnect()
        except RobotBusError as exc:  # of what is gone already
            logger.warning("%s", exc)
        self.connect()

    def disconnect(self) -> None:
        """Disconnect; LeRobot then switches a robot's motors off, if its configuration says so."""
        if self.device.is_connected:
            with self.errors("disconnecting"):
                self.device.disconnect()

    def positions(self, found: Mapping[str, Any]) -> Motors:
        """Return those of the motors in what was read; raise if one is missing, or not finite."""
        values = [found.get(f"{name}{POSITION}") for name in self.motors]
        for name, value in zip(self.motors, values, strict=True):
            if value is None or not np.isfinite(value):
                raise RobotBusError(
                    f"{self.kind} '{self.device.name}': expected a position of the motor '{name}', found "
                    f"{value}. Check its cable and its id."
                )
        return np.array(values, dtype=np.float64)

    @contextlib.contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Turn whatever the device raises into a `RobotBusError`."""
        try:
            yield
        except Exception as exc:  # LeRobot's drivers raise what their libraries raise
            said = " ".join(str(exc).split())
            raise RobotBusError(
                f"{self.kind} '{self.device.name}', {doing}: {type(exc).__name__}: {said} Check cables and "
                "power, then run the command again."
            ) from exc


class RobotLink(DeviceLink):
    """A LeRobot robot with motors that are commanded by position, and cameras."""

    kind = "robot"

    def __init__(self, robot: Any) -> None:
        """Read what the robot offers; nothing is connected."""
        super().__init__(robot)
        offered, commanded = dict(robot.observation_features), dict(robot.action_features)
        self.motors = tuple(name.removesuffix(POSITION) for name in commanded)
        wrong = [name for name in commanded if not name.endswith(POSITION) or name not in offered]
        if wrong or not commanded:
            raise RobotError(
                f"robot '{robot.name}': expected actions that are positions of motors (`NAME{POSITION}`), "
                f"which it also observes; found {', '.join(wrong) or 'none'}. This robot cannot be used here."
            )
        self.cameras = tuple(
            CameraSpec(name=name, height_px=shape[0], width_px=shape[1], fov_rad=None)
            for name, shape in offered.items()
            if isinstance(shape, tuple) and len(shape) == CHANNELS and shape[2] == CHANNELS
        )

    def read(self) -> Reading:
        """Return positions and images; raise if anything is missing, of another shape, or not finite."""
        with self.errors("reading"):
            found = self.device.get_observation()
        motors = self.positions(found)
        return Reading(motors=motors, images={one.name: self._image(found, one) for one in self.cameras})

    def send(self, goal: Motors) -> None:
        """Command the motors."""
        with self.errors("commanding"):
            pairs = zip(self.motors, goal.tolist(), strict=True)
            self.device.send_action({f"{name}{POSITION}": position for name, position in pairs})

    def _image(self, found: Mapping[str, Any], camera: CameraSpec) -> ImageArray:
        image, expected = found.get(camera.name), (camera.height_px, camera.width_px, CHANNELS)
        if not isinstance(image, np.ndarray) or image.shape != expected or image.dtype != np.uint8:
            what = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else f"{image!r:.60}"
            raise RobotCameraError(
                f"robot '{self.device.name}': expected an image uint8 {expected} of the camera "
                f"'{camera.name}', found {what}. Check the camera and its settings."
            )
        return image.copy()
