"""Leaving out what no view shows changes no pixel."""

from typing import Literal

import numpy as np
import pytest

from tests.tasks.sample import SAMPLE
from vla_eval.config.environment import AppearanceSettings, EnvSettings, RenderSettings
from vla_eval.core import ImageArray
from vla_eval.envs.factory import make_env
from vla_eval.envs.scenes import take_images

CAMERAS = ("base_camera", "hand_camera")
SEED = 1
N_STEPS = 8
ACTION = (0.4, -0.3, -0.2, 0.5, -0.5, 0.6, 0.0)  # moves the arm and turns the hand about each axis


# The camera is the same in each task.
@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=() if task == "TakeItBack-v0" else pytest.mark.slow) for task in SAMPLE],
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


@pytest.mark.parametrize(
    ("task", "clutter", "appearance"),
    [
        pytest.param("ShellGameTouch-v0", 0, AppearanceSettings(), marks=pytest.mark.slow),
        ("ChainOfColors3-v0", 4, AppearanceSettings(light=0.6, hue_deg=40, table_rgb=(0.2, 0.4, 0.3))),
    ],
)
def test_the_wrist_camera_s_own_scene_shows_what_the_whole_scene_shows(
    task: str, clutter: int, appearance: AppearanceSettings
) -> None:
    settings = EnvSettings(task=task, cameras=CAMERAS, kwargs={"clutter": clutter}, appearance=appearance)
    env = make_env(settings)
    (inner,), (view,) = env._envs, env._wrist_views
    rng, n_apart = np.random.default_rng(0), 0
    for seed in (1, 2):  # a new scene per episode
        env.reset({0: seed}, render=False)
        for _ in range(12):  # cue, delay, and what is revealed then; the hand turns about each axis
            action = np.append(rng.uniform(-1, 1, 6), 0).astype(np.float32)
            seen = env.step({0: action}, render=frozenset({0}))[0].observation.images
            n_apart += view.submit(inner)
            whole = take_images(inner, CAMERAS)
            for camera in CAMERAS:
                np.testing.assert_array_equal(seen[camera], whole[camera][0])
    env.close()
    assert n_apart > 12, "most images were drawn with the whole scene"


def test_the_arm_is_drawn_where_it_may_be_seen() -> None:
    env = make_env(EnvSettings(task="RememberColor3-v0", cameras=("hand_camera",)))
    env.reset({0: 1}, render=True)
    (inner,), (view,) = env._envs, env._wrist_views
    assert set(view._left_out) >= {f"panda_link{i}" for i in range(6)}
    qpos = inner.agent.robot.get_qpos().clone()
    assert view.submit(inner)
    qpos[0, 5] = 0.5  # the hand is bent back: its camera sees the forearm
    inner.agent.robot.set_qpos(qpos)
    assert not view.submit(inner)
    seen = take_images(inner, ("hand_camera",), view)["hand_camera"]
    np.testing.assert_array_equal(seen, take_images(inner, ("hand_camera",))["hand_camera"])
    env.close()
