"""The mesh that ships draws what the whole mesh of the wrist camera draws."""

from typing import Literal

import numpy as np
import pytest

from tests.tasks.sample import SAMPLE
from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.core import ImageArray
from vla_eval.envs.factory import make_env

CAMERAS = ("base_camera", "hand_camera")
SEED = 1
N_STEPS = 8
ACTION = (0.4, -0.3, -0.2, 0.5, -0.5, 0.6, 0.0)  # moves the arm and turns the hand about each axis


# The camera is the same in each task.
@pytest.mark.parametrize(
    "task",
    [
        pytest.param(task, marks=() if task in ("ChainOfColors3-v0", "TakeItBack-v0") else pytest.mark.slow)
        for task in SAMPLE
    ],
)
def test_a_frame_of_each_task_is_equal_to_the_bit_to_that_with_the_whole_mesh(task: str) -> None:
    """Both are drawn here: a stored digest would hold for one model of processor alone."""
    shipped, whole = (_frames(task, mesh) for mesh in ("shipped", "whole"))
    for camera in CAMERAS:
        np.testing.assert_array_equal(shipped[camera], whole[camera])


def _frames(task: str, mesh: Literal["shipped", "whole"]) -> dict[str, ImageArray]:
    env = make_env(EnvSettings(task=task, cameras=CAMERAS, render=RenderSettings(wrist_mesh=mesh)))
    env.reset({0: SEED}, render=False)
    action = np.array(ACTION, np.float32)
    for step in range(1, N_STEPS + 1):
        drawn = frozenset({0}) if step == N_STEPS else frozenset[int]()
        result = env.step({0: action}, render=drawn)[0]
    env.close()
    return dict(result.observation.images)
