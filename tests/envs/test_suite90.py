"""Every task of the official package: rows, states, determinism. `make suite90`, then `-m suite90`."""

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.prompts import instruction_for
from vla_eval.core import EpisodeStart, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.envs.official import CAMERAS, official_class
from vla_eval.envs.scenes import take_images
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.registry import make_from_adapter
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.tasks.catalog import OFFICIAL_TASKS, SUITES, task_spec
from vla_eval.testing.check_env import check_env

pytestmark = [
    pytest.mark.suite90,
    pytest.mark.skipif(importlib.util.find_spec("mikasa_robo_suite") is None, reason="needs `make suite90`"),
]
SEED = 4242424242
N_STEPS = 40  # beyond the reveal of all tasks but the long ones
TABLE_M = -0.05, 0.6  # of the centre of anything that lies or is held on the table
STAND_IN = {"mug": "stand_in", "bulb": "stand_in"}
SCRIPTED = [task for task, row in SUITES["mikasa_vla_90"].items() if row.oracle]
ORACLES_OF = (
    *("RememberColor9", "RememberShape5", "RememberShapeAndColor3x3", "FindImposterColor5"),
    *("FindImposterShape9", "FindImposterShapeAndColor5x3", "ShellGameTouch", "ShellGamePush"),
    *("ShellGameColorLampTouch", "ShellGameShuffleTouch", "ShellGameShuffleColorLampTouch"),
    *("InterceptGrabSlow", "RotateLenientPos", "TakeItBack"),
)


def hold(env: Any, seed: int, n_steps: int) -> list[StepResult]:
    results = [env.reset({0: seed}, render=False)[0]]
    for _ in range(n_steps):
        results.append(env.step({0: env.hold_action(0)}, render=frozenset())[0])
    return results


def dynamic(env: Any) -> dict[str, np.ndarray]:
    """Return name -> (3,) position of what forces move."""
    actors = env._envs[0].scene.actors.items()
    return {name: a.pose.p[0].numpy().copy() for name, a in actors if a.px_body_type == "dynamic"}


@pytest.mark.parametrize("task", OFFICIAL_TASKS)
def test_true_states_are_as_intended_and_an_episode_depends_on_its_seed(task: str) -> None:
    env = make_env(EnvSettings(task=task, kwargs=STAND_IN))
    inner = env._envs[0]  # type: ignore[attr-defined]
    first = hold(env, SEED, N_STEPS)

    # Evaluating again changes nothing.
    shown, info = dynamic(env), inner.evaluate()
    again = inner.evaluate()
    assert info["success"].tolist() == again["success"].tolist()
    np.testing.assert_equal(dynamic(env), shown)

    # Nothing has fallen: it is on the table, or parked where it was parked.
    inner.put_back()
    for name, position in dynamic(env).items():
        is_parked = abs(position[2] - 1000) < 0.5
        assert is_parked or TABLE_M[0] < position[2] < TABLE_M[1], (name, position)

    hold(env, 7, 3)
    for one, two in zip(first, hold(env, SEED, N_STEPS), strict=True):
        assert one.reward == two.reward
        for name, value in one.observation.state.items():
            np.testing.assert_array_equal(value, two.observation.state[name])
    env.close()


@pytest.mark.parametrize("task", OFFICIAL_TASKS)
def test_a_camera_s_own_scene_shows_what_the_whole_scene_shows(task: str) -> None:
    """Things are hidden and lit while an episode runs, and balls fly."""
    cameras = tuple(camera.name for camera in CAMERAS)
    env = make_env(EnvSettings(task=task, cameras=cameras, kwargs=STAND_IN))
    inner = env._envs[0]  # type: ignore[attr-defined]
    env.reset({0: 1}, render=True)
    rng = np.random.default_rng(0)
    for step in range(N_STEPS):
        drawn = frozenset({0} if step % 4 == 0 else ())
        action = np.append(rng.uniform(-1, 1, 6), 0).astype(np.float32)
        seen = env.step({0: action}, render=drawn)[0].observation.images
        if drawn:
            whole = take_images(inner, cameras)
            for camera in cameras:
                np.testing.assert_array_equal(seen[camera], whole[camera][0])
    env.close()


@pytest.mark.parametrize("task", OFFICIAL_TASKS)
def test_every_task_can_be_rendered(task: str) -> None:
    cameras = ("base_camera", "hand_camera")
    env = make_env(EnvSettings(task=task, kwargs=STAND_IN, cameras=cameras))
    images = env.reset({0: SEED}, render=True)[0].observation.images
    assert {name: image.shape for name, image in images.items()} == dict.fromkeys(cameras, (128, 128, 3))
    assert all(image.std() > 1 for image in images.values())
    env.close()


@pytest.mark.parametrize("task", OFFICIAL_TASKS)
def test_the_rows_are_what_the_package_registers(task: str) -> None:
    row = task_spec(task)
    official_class(row)
    registered = importlib.import_module("mani_skill.utils.registration").REGISTERED_ENVS
    found = registered[task.split("/")[1]]
    assert row.horizon_steps == found.max_episode_steps
    if row.suite == "mikasa_vla_90" and hasattr(found.cls, "LANGUAGE_INSTRUCTION"):
        assert instruction_for(row) == found.cls.LANGUAGE_INSTRUCTION
    if "velocity_range_m_s" in row.kwargs:
        assert row.kwargs["velocity_range_m_s"] == found.cls.VELOCITY_RANGE


@pytest.mark.parametrize("task", SCRIPTED)
def test_controls_are_given_the_true_state(task: str) -> None:
    env = make_env(EnvSettings(task=task, kwargs=STAND_IN, privileged=True))
    result = env.reset({0: SEED}, render=False)[0]
    state, chance = result.observation.privileged, task_spec(task).chance_success
    assert state is not None
    if chance is None:
        assert state.bodies and not result.status.n_candidates
    else:
        assert result.status.n_candidates == round(1 / chance)
        assert ((state.candidate_positions_m[:, 2] > 0) & (state.candidate_positions_m[:, 2] < 0.1)).all()
    env.close()


def won(task: str, policy: str, n_episodes: int) -> list[bool | None]:
    """Whether a control wins the first episodes of the protocol."""
    env = make_env(EnvSettings(task=task, kwargs=STAND_IN, privileged=True))
    chunking, chance = ChunkingSpec(n_action_steps=1), task_spec(task).chance_success
    context = PolicyContext(
        name=policy, env=env.spec, chunking=chunking, n_candidates=round(1 / chance) if chance else 0
    )
    control = make_from_adapter(policy, context, {})
    found = []
    for seed in range(SEED, SEED + n_episodes):
        start = EpisodeStart(
            slot=0, task=task, seed=seed, run=0, instruction="-", horizon_steps=env.spec.horizon_steps
        )
        settings = RolloutSettings(chunking=chunking, stop_at_success=True)
        found += [record.success_once for record in rollout(env, control, [start], settings)]
    env.close()
    return found


# docs/audit_official.md counts ten seeds of each. The expert misses one of InterceptMedium, the second, and
# going to the cue three of RememberShape9-Long: tasks of which the first two seeds are won stand here.
@pytest.mark.parametrize("name", ORACLES_OF)
def test_the_expert_wins_a_task_of_each_family(name: str) -> None:
    assert won(f"mikasa_vla/{name}-VLA-v0", "oracle", 2) == [True, True]


@pytest.mark.parametrize(
    "name", ["RememberColor3-Long", "RememberShape5-Long", "RememberShapeAndColor5x3-Long"]
)
def test_going_to_the_cue_wins_the_long_remember_tasks(name: str) -> None:
    assert won(f"mikasa_vla/{name}-VLA-v0", "cue_touch", 2) == [True, True]


def test_the_tasks_that_wait_are_those_that_the_official_wrapper_stops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The wrappers' module imports the package's trainer, which needs tensorboard.
    trainer: Any = ModuleType("baselines.ppo.ppo_memtasks")
    trainer.FlattenRGBDObservationWrapper = None
    monkeypatch.setitem(sys.modules, "baselines.ppo.ppo_memtasks", trainer)
    wrappers = importlib.import_module("mikasa_robo_suite.vla.utils.apply_wrappers")
    official = {
        f"mikasa_vla/{name}": config.curriculum_wrapper is not None
        for name, config in wrappers.VLA_WRAPPER_CONFIGS.items()
    }
    assert official == {task: row.waits_for_choice for task, row in SUITES["mikasa_vla_90"].items()}


@pytest.mark.parametrize("task", ["mikasa_vla/RememberColor3-VLA-v0", "mikasa_official/RememberColor3-v0"])
def test_lazy_images_are_those_of_eager_rendering(task: str) -> None:
    check_env(lambda: make_env(EnvSettings(task=task, cameras=("base_camera", "hand_camera"))))


def test_the_goal_of_the_shell_game_is_hidden_from_the_cameras() -> None:
    task = "mikasa_vla/ShellGamePush-VLA-v0"
    env = make_env(EnvSettings(task=task, kwargs=STAND_IN, cameras=("base_camera",)))
    first = env.reset({0: 1}, render=True)[0].observation.images["base_camera"]
    goal = env._envs[0].goal_site  # type: ignore[attr-defined]
    assert goal.hidden and first.shape == (128, 128, 3)
    env.close()


def test_an_evaluation_runs_and_resumes(tmp_path: Path) -> None:
    from vla_eval.cli.main import main

    out = str(tmp_path / "run")
    command = ["eval", "--task", "mikasa_vla/RememberColor3-VLA-v0", "--policy", "hold", "random"]
    command += ["--seed-start", str(SEED), "--workers", "1", "--out", out]
    assert main([*command, "--episodes", "2"]) == 0
    assert main([*command, "--episodes", "2", "--set", "workers=2"]) == 0
