"""What tasks offer to a policy is said in one place, without a simulator."""

from vla_eval.features import CAMERA_KEYS, FPS
from vla_eval.tasks.interface import CAMERAS, CONTROL_HZ


def test_demonstrations_hold_every_camera_at_the_control_rate() -> None:
    assert [camera.name for camera in CAMERAS] == list(CAMERA_KEYS)
    assert CONTROL_HZ == FPS
