"""Leaving out what no view shows changes no pixel."""

from typing import Any, Literal

import numpy as np
import pytest

from tests.tasks.sample import SAMPLE
from vla_eval.config.environment import AppearanceSettings, EnvSettings, RenderSettings
from vla_eval.core import ImageArray
from vla_eval.envs.camera_view import CameraView
from vla_eval.envs.factory import make_env
from vla_eval.envs.pixel_cover import Chosen, Lens, Matrix, Mesh, covering
from vla_eval.envs.scenes import take_images
from vla_eval.tasks.catalog import TASKS

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


LIT = AppearanceSettings(light=0.6, hue_deg=40, table_rgb=(0.2, 0.4, 0.3))


@pytest.mark.parametrize(
    ("task", "arguments", "appearance"),
    [
        ("ChainOfColors3-v0", {"clutter": 4}, LIT),
        ("RememberObject3-v0", {"image_size": 200}, AppearanceSettings()),
        pytest.param("RememberColor3-v0", {"robot": "fetch"}, AppearanceSettings(), marks=pytest.mark.slow),
        pytest.param("ShellGameTouch-v0", {"robot": "so100"}, AppearanceSettings(), marks=pytest.mark.slow),
        pytest.param("RememberColor3-v0", {"robot": "koch"}, AppearanceSettings(), marks=pytest.mark.slow),
        *(pytest.param(task, {}, AppearanceSettings(), marks=pytest.mark.slow) for task in sorted(TASKS)),
    ],
)
def test_a_camera_s_own_scene_shows_what_the_whole_scene_shows(
    task: str, arguments: dict[str, Any], appearance: AppearanceSettings
) -> None:
    settings = EnvSettings(task=task, cameras=CAMERAS, kwargs=arguments, appearance=appearance)
    env = make_env(settings)
    (inner,), (views,) = env._envs, env._views
    rng, n_dims = np.random.default_rng(0), len(env.spec.action.dims)
    for seed in (1, 2):  # a new scene per episode
        env.reset({0: seed}, render=False)
        for _ in range(12):  # cue, delay, and what is revealed then; the hand turns about each axis
            action = np.append(rng.uniform(-1, 1, n_dims - 1), 0).astype(np.float32)
            seen = env.step({0: action}, render=frozenset({0}))[0].observation.images
            whole = take_images(inner, CAMERAS)
            for camera in CAMERAS:
                np.testing.assert_array_equal(seen[camera], whole[camera][0])
    assert all(view._culled for view in views.values())
    env.close()


def test_the_arm_is_drawn_where_it_may_be_seen() -> None:
    env = make_env(EnvSettings(task="RememberColor3-v0", cameras=("hand_camera",)))
    (inner,), (views,) = env._envs, env._views

    def links_drawn() -> set[str]:
        return {one.entity.name for one in views["hand_camera"]._culled if one.copy is not None}

    env.reset({0: 1}, render=True)
    beside_it = links_drawn()
    assert not {name for name in beside_it if name.startswith("panda_link")}
    qpos = inner.agent.robot.get_qpos().clone()
    for bent, is_seen in ((0.5, True), (float(qpos[0, 5]), False)):  # the hand's camera sees the forearm
        qpos[0, 5] = bent
        inner.agent.robot.set_qpos(qpos)
        seen = take_images(inner, ("hand_camera",), views)["hand_camera"]
        np.testing.assert_array_equal(seen, take_images(inner, ("hand_camera",))["hand_camera"])
        assert (links_drawn() > beside_it) is is_seen
    env.close()


def test_where_a_light_casts_shadows_all_triangles_are_drawn() -> None:
    env = make_env(EnvSettings(task="RememberColor3-v0", cameras=("base_camera",)))
    (inner,), (views,) = env._envs, env._views
    env.reset({0: 1}, render=True)
    assert views["base_camera"]._culled
    inner.scene.sub_scenes[0].render_system.lights[0].shadow = True
    view = CameraView("base_camera", {})
    view.submit(inner)
    view.image()  # a scene that is freed while it is drawn crashes the process
    assert not view._culled
    env.close()


def test_what_keeps_its_place_to_the_camera_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(EnvSettings(task="RememberColor3-v0", cameras=CAMERAS))
    env.reset({0: 1}, render=True)
    asked: list[int] = []

    def counted(mesh: Mesh, view: Matrix, lens: Lens) -> Chosen:
        asked.append(len(mesh.corners[0]))
        return covering(mesh, view, lens)

    monkeypatch.setattr("vla_eval.envs.camera_view.covering", counted)
    env.step({0: np.array(ACTION, np.float32)}, render=frozenset({0}))
    n_of = {one.entity.name: len(one.dense.mesh.corners[0]) for one in env._views[0]["base_camera"]._culled}
    moved = [count for name, count in n_of.items() if name not in {"panda_link0", "scene-0_ground"}]
    assert asked
    assert set(asked) <= set(moved)
    assert len(asked) == len(set(asked)), "the hand's camera asked, too"
    env.close()
