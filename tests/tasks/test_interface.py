"""What tasks offer to a policy is said in one place, without a simulator."""

import pytest

from vla_eval.config.environment import EnvSettings, Simulator
from vla_eval.envs.factory import make_env
from vla_eval.features import CAMERA_KEYS, FPS
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import CAMERAS, CONTROL_HZ, env_spec


@pytest.mark.parametrize("simulator", ["maniskill", "fake"])
def test_the_offer_of_a_task_is_that_of_its_environment(simulator: Simulator) -> None:
    env = make_env(EnvSettings(task="RememberColor3-v0", simulator=simulator))
    try:
        assert env_spec(task_spec("RememberColor3-v0")) == env.spec
    finally:
        env.close()


def test_demonstrations_hold_every_camera_at_the_control_rate() -> None:
    assert [camera.name for camera in CAMERAS] == list(CAMERA_KEYS)
    assert CONTROL_HZ == FPS
