"""The adapter of the official tasks, on a small environment in place of an official one."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from tests.envs.hiding_env import HidingEnv
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, StepResult
from vla_eval.envs import official
from vla_eval.envs.factory import make_env
from vla_eval.envs.official import official_class
from vla_eval.envs.official_assets import SHAPES, provide_bulb
from vla_eval.envs.official_settings import WITH_LAMPS
from vla_eval.envs.scenes import build
from vla_eval.errors import MissingDependencyError, TaskArgumentError, UnknownNameError
from vla_eval.tasks.catalog import OFFICIAL_TASKS, SUITES, task_spec
from vla_eval.tasks.catalogs.official_catalog import MIKASA_VLA_90

TASK = "mikasa_vla/RememberColor3-VLA-v0"
CUE_STEPS, DELAY_STEPS = 2, 1


class SmallTask(HidingEnv):
    """A RememberColor3: with an arm, three cubes, and a cue and a delay of fixed lengths."""

    GOAL_THRESH = 0.05

    def __init__(self, **kwargs: Any) -> None:
        own = ("num_envs", "obs_mode", "robot_uids", "sim_backend", "render_backend")
        super().__init__(**{name: value for name, value in kwargs.items() if name not in own})

    def _initialize_episode(self, env_idx: Any, options: Any) -> None:
        super()._initialize_episode(env_idx, options)
        self.cue_steps_per_env = torch.tensor([CUE_STEPS])
        self.empty_steps_per_env = torch.tensor([DELAY_STEPS])
        self.cubes = dict(enumerate((self.hidden, self.parked, self.placed)))
        self.initial_poses = {key: torch.tensor([[0.0, 0.1 * key, 0.02]]) for key in self.cubes}
        self.true_color_indices = torch.tensor([2], dtype=torch.uint8)
        qpos = np.array([0, 0, 0, -np.pi * 2 / 3, 0, np.pi * 2 / 3, np.pi / 4, 0.04, 0.04])
        qpos[:7] += self._episode_rng.normal(0, 0.02, 7)
        self.agent.reset(qpos)


@pytest.fixture(scope="module")
def env() -> Any:
    patch = pytest.MonkeyPatch()
    patch.setattr(official, "official_class", lambda row: SmallTask)
    made = make_env(EnvSettings(task=TASK, n_slots=2))
    yield made
    made.close()
    patch.undo()


def run(env: Any, seed: int, *, slot: int = 0) -> list[StepResult]:
    """Open the gripper and move along +x for 4 steps."""
    action = np.array([1, 0, 0, 0, 0, 0, 1], dtype=np.float32)
    results = [env.reset({slot: seed}, render=False)[slot]]
    return results + [env.step({slot: action}, render=frozenset())[slot] for _ in range(4)]


def test_actions_are_replaced_by_zeros_until_the_choice(env: Any) -> None:
    executed = [result.executed_action for result in run(env, 4242424242)[1:]]
    # As the official wrapper: while the elapsed steps are fewer than those of cue and delay, 2 + 1.
    assert [bool(np.any(action)) for action in executed] == [False, False, False, True]


def test_phases_are_those_that_the_environment_has_drawn(env: Any) -> None:
    assert [result.status.phase for result in run(env, 1)] == ["cue", "cue", "delay", "response", "response"]


def test_an_episode_depends_on_its_seed_alone(env: Any) -> None:
    alone = run(env, 4242424242)
    run(env, 3)
    reused, elsewhere = run(env, 4242424242), run(env, 4242424242, slot=1)
    for other in (reused, elsewhere):
        for one, two in zip(alone, other, strict=True):
            for name, value in one.observation.state.items():
                np.testing.assert_array_equal(value, two.observation.state[name])


def test_observations_hold_neither_prompt_nor_oracle(env: Any) -> None:
    observation = run(env, 1)[0].observation
    assert set(observation.state) == {"tcp_pose", "qpos", "qvel"}
    assert observation.privileged is None


def test_the_largest_seed_is_that_of_numpy(env: Any) -> None:
    env.reset({0: 2**32 - 1}, render=False)
    with pytest.raises(TaskArgumentError, match="seed 4294967296: the official environments take 0 to"):
        env.reset({0: 2**32}, render=False)


def test_holding_keeps_the_width_of_the_gripper(env: Any) -> None:
    env.reset({0: 1}, render=False)
    # 0.04 m per finger is the end of the range -0.01 to 0.04 m: action 1.
    np.testing.assert_allclose(env.hold_action(0), [0, 0, 0, 0, 0, 0, 1], atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (
            {"sim_backend": "gpu"},
            TaskArgumentError,
            "sim_backend=gpu: the official environments run on the CPU",
        ),
        ({"kwargs": {"cue_steps": 5}}, UnknownNameError, "no argument 'cue_steps'"),
        ({"kwargs": {"horizon_steps": 0}}, TaskArgumentError, "horizon_steps=0: expected 1 to 10000"),
        ({"cameras": ("top",)}, UnknownNameError, "no camera 'top'"),
    ],
)
def test_what_the_official_tasks_cannot_do_is_refused(
    settings: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make_env(EnvSettings(task=TASK, **settings))


def test_the_true_state_is_in_the_observation_only_where_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(official, "official_class", lambda row: SmallTask)
    made = make_env(EnvSettings(task=TASK, privileged=True))
    results = run(made, 1)
    states = [result.observation.privileged for result in results]
    assert [state and (state.target, state.phase) for state in states] == [
        (2, "cue"),
        (2, "cue"),
        (2, "delay"),
        (2, "response"),
        (2, "response"),
    ]
    assert results[0].status.n_candidates == 3
    made.close()


def test_without_the_package_the_message_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mikasa_robo_suite", None)
    with pytest.raises(MissingDependencyError, match="Run `make suite90`"):
        official_class(task_spec(TASK))


def test_a_lamp_without_its_file_is_an_error_or_has_a_sphere_as_the_run_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made: list[Any] = []
    shapes = ModuleType(SHAPES)
    shapes.__file__ = str(tmp_path / "shapes.py")
    lamp = lambda _name, bulb_asset_path=None: made.append(bulb_asset_path)  # noqa: E731
    monkeypatch.setattr(shapes, "build_color_switch_lamp", lamp, raising=False)
    monkeypatch.setitem(sys.modules, SHAPES, shapes)
    monkeypatch.setattr("vla_eval.envs.official_assets.cached", lambda name: tmp_path / name)
    file = tmp_path / "objects" / "low_poly_light_bulb.glb"
    with pytest.raises(MissingDependencyError, match=f"{file}.*--set env.bulb=stand_in"):
        provide_bulb("package", task=TASK)

    assert provide_bulb("stand_in", task=TASK) == "stand-in of this package: a sphere"
    shapes.build_color_switch_lamp("lamp")
    sphere = trimesh.load(made[-1], force="mesh")
    # 12 mm around the point that the lamp maker lowers by 7 cm, once it has scaled the file by 0.85.
    np.testing.assert_allclose(0.85 * sphere.bounds.mean(axis=0), (0, 0.07, 0), atol=1e-6)
    np.testing.assert_allclose(0.85 * sphere.extents / 2, 0.012, atol=2e-4)

    file.parent.mkdir()
    file.touch()
    assert provide_bulb("package", task=TASK) == "the package's"
    shapes.build_color_switch_lamp("lamp")
    assert made[-1] is None


def test_the_original_tasks_are_the_paper_s_but_for_those_with_a_peg() -> None:
    original = {task.removeprefix("mikasa_official/") for task in OFFICIAL_TASKS if "official/" in task}
    assert original == {task for task in SUITES["paper"] if "Rotate" not in task}


def test_lamps_are_known_by_the_names_of_their_tasks() -> None:
    with_lamps = [task for task in MIKASA_VLA_90 if task.rpartition("/")[2].startswith(WITH_LAMPS)]
    assert len(with_lamps) == 30


def test_a_file_of_a_scene_that_is_not_there_is_no_renderer_that_did_not_start() -> None:
    def scene(**_: Any) -> Any:
        raise RuntimeError(
            "filesystem error: cannot make canonical path: No such file or directory [/a/lamp.glb]"
        )

    with pytest.raises(MissingDependencyError, match=r"expected the file /a/lamp\.glb, of which its scene"):
        build(scene, EnvSettings(task=TASK))


def test_the_angle_of_an_episode_is_put_into_its_instruction() -> None:
    start = EpisodeStart(
        slot=0, task=TASK, seed=1, run=0, instruction="Rotate by {angle_deg} degrees.", horizon_steps=60
    )
    status: Any = None
    observation: Any = None
    reset = StepResult(observation=observation, status=status, wording={"angle_deg": "44"})
    assert start.worded(reset.wording).instruction == "Rotate by 44 degrees."
