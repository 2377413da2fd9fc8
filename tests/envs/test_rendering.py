"""What a policy sees: the same pixels however and wherever the episode runs, and nothing in vain."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.forked import run_forked
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, Observation, ObservationWindow, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.errors import RenderingError, UnknownNameError
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.register import env_class

CAMERAS = ("base_camera", "hand_camera")
N_STEPS = 17  # past the reveal at step 10, and no multiple of the chunk lengths below
SHORT: dict[str, Any] = {"horizon_steps": N_STEPS}


class SeeingPolicy:
    """Acts on what it sees, so that one different pixel changes the episode; keeps what it saw."""

    def __init__(self, chunk_size: int, *, reads: Any = "last") -> None:
        self.spec = PolicySpec(
            name="seeing", reads=reads, cameras=CAMERAS, states=("qpos",), chunk_size=chunk_size
        )
        self.seen: dict[int, Observation] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        self.seen = {}

    def act(self, window: ObservationWindow) -> ActionChunk:
        for frame in window.frames:
            self.seen[frame.step] = frame
        seed = int(sum(int(image.sum()) for image in window.last.images.values()))
        drawn = np.random.default_rng(seed).uniform(-1, 1, (self.spec.chunk_size, 7))
        return ActionChunk(actions=drawn.astype(np.float32))


class CountingEnv:
    """Counts the pictures that are taken."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.spec = env.spec
        self.n_rendered = 0

    def reset(self, seeds: Any, *, render: bool) -> dict[int, StepResult]:
        self.n_rendered += render
        return dict(self._env.reset(seeds, render=render))

    def step(self, actions: Any, *, render: frozenset[int]) -> dict[int, StepResult]:
        self.n_rendered += len(render)
        return dict(self._env.step(actions, render=render))

    def hold_action(self, slot: int) -> FloatArray:
        action: FloatArray = self._env.hold_action(slot)
        return action

    def close(self) -> None:
        self._env.close()


@pytest.fixture(scope="module")
def env() -> Any:
    settings = EnvSettings(
        task="RememberColor3-v0",
        kwargs=SHORT,
        cameras=CAMERAS,
        render=RenderSettings(wrist_mesh="simplified"),
    )
    return make_env(settings)


def run(env: Any, policy: SeeingPolicy, *, seed: int, eager: bool = False) -> tuple[EpisodeRecord, int]:
    counting = CountingEnv(env)
    start = EpisodeStart(
        slot=0, task=env.spec.task, seed=seed, run=0, instruction="go", horizon_steps=N_STEPS
    )
    chunking = ChunkingSpec(n_action_steps=policy.spec.chunk_size)
    settings = RolloutSettings(chunking=chunking, eager_rendering=eager)
    (record,) = rollout(counting, policy, [start], settings)
    return record, counting.n_rendered


@pytest.mark.parametrize("chunk_size", [4, *(pytest.param(size, marks=pytest.mark.slow) for size in (1, 8))])
def test_lazy_rendering_gives_the_frames_and_states_of_eager_rendering(env: Any, chunk_size: int) -> None:
    lazy, eager = SeeingPolicy(chunk_size), SeeingPolicy(chunk_size)
    lazy_record, n_lazy = run(env, lazy, seed=3)
    eager_record, n_eager = run(env, eager, seed=3, eager=True)
    assert lazy_record == eager_record  # with the digest of all states and actions
    inference_steps = list(range(0, N_STEPS, chunk_size))
    assert sorted(lazy.seen) == sorted(eager.seen) == inference_steps
    for step in inference_steps:
        for camera in CAMERAS:
            assert np.array_equal(lazy.seen[step].images[camera], eager.seen[step].images[camera])
    assert (n_lazy, n_eager) == (len(inference_steps), N_STEPS + 1)


def test_a_policy_that_reads_every_frame_sees_every_step_before_its_last_inference(env: Any) -> None:
    policy = SeeingPolicy(4, reads="every")
    run(env, policy, seed=3)
    assert sorted(policy.seen) == list(range(17))  # inferences at 0, 4, 8, 12, 16
    assert all(set(frame.images) == set(CAMERAS) for frame in policy.seen.values())


def test_frames_do_not_depend_on_the_episodes_before_or_on_the_environment(env: Any) -> None:
    first, again, fresh = (SeeingPolicy(4) for _ in range(3))
    run(env, first, seed=5)
    run(env, SeeingPolicy(4), seed=6)
    run(env, again, seed=5)
    settings = EnvSettings(
        task="RememberColor3-v0",
        kwargs=SHORT,
        cameras=CAMERAS,
        render=RenderSettings(wrist_mesh="simplified"),
    )
    run(make_env(settings), fresh, seed=5)
    for step, frame in first.seen.items():
        for other in (again, fresh):
            for camera in CAMERAS:
                assert np.array_equal(frame.images[camera], other.seen[step].images[camera]), (step, camera)


def test_pictures_are_those_of_maniskills_own_rgb_observation(env: Any) -> None:
    results = env.reset({0: 9}, render=True)
    spec = task_spec("RememberColor3-v0")
    official = env_class(spec)(
        obs_mode="rgb",
        control_mode="pd_ee_delta_pose",
        render_backend="sapien_cpu",
        robot_uids="panda_wristcam_light",
        **spec.kwargs,
    )
    obs, _ = official.reset(seed=[9])
    for camera in CAMERAS:
        theirs = obs["sensor_data"][camera]["rgb"][0].numpy()
        assert theirs.shape == (128, 128, 3)
        assert theirs.dtype == np.uint8
        assert np.array_equal(results[0].observation.images[camera], theirs)
    assert set(obs["extra"]) == {"tcp_pose"}, "a visual observation must not hold the answer"


def test_states_with_and_without_a_renderer_are_bit_equal(env: Any) -> None:
    blind = make_env(EnvSettings(task="RememberColor3-v0", kwargs=SHORT))
    rng = np.random.default_rng(0)
    seen, unseen = env.reset({0: 2}, render=True)[0], blind.reset({0: 2}, render=False)[0]
    for _ in range(N_STEPS):
        for name in seen.observation.state:
            assert np.array_equal(seen.observation.state[name], unseen.observation.state[name])
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        seen = env.step({0: action}, render=frozenset({0}))[0]
        unseen = blind.step({0: action}, render=frozenset())[0]
    assert unseen.observation.images == {}


def test_the_simplified_mesh_changes_neither_physics_nor_the_wrist_view(env: Any) -> None:
    shipped = make_env(EnvSettings(task="RememberColor3-v0", kwargs=SHORT, cameras=CAMERAS))
    simple_frame = env.reset({0: 4}, render=True)[0].observation
    shipped_frame = shipped.reset({0: 4}, render=True)[0].observation
    assert np.array_equal(simple_frame.state["qpos"], shipped_frame.state["qpos"])
    assert np.array_equal(simple_frame.images["hand_camera"], shipped_frame.images["hand_camera"])
    base = np.abs(
        simple_frame.images["base_camera"].astype(int) - shipped_frame.images["base_camera"].astype(int)
    )
    assert (base.max(axis=2) > 8).mean() < 0.005  # only some pixels on the camera's own body


def assert_same_frames(task: str, *, seeds: Sequence[int], n_steps: int) -> None:
    """Run random actions with the mesh as it is drawn and with all of it; compare every pixel."""
    drawn, whole = (
        make_env(EnvSettings(task=task, cameras=CAMERAS, render=RenderSettings(wrist_mesh=mesh)))
        for mesh in ("shipped", "whole")
    )
    for seed in seeds:
        rng = np.random.default_rng(seed)
        frames = [env.reset({0: seed}, render=True)[0].observation for env in (drawn, whole)]
        for step in range(n_steps + 1):
            for camera in CAMERAS:
                images = [frame.images[camera] for frame in frames]
                assert np.array_equal(*images), f"{task}, seed {seed}, step {step}, {camera}"
            # The same for four steps: the arm gets far from where it began, and turns.
            if step % 4 == 0:
                action = rng.uniform(-1, 1, 7).astype(np.float32)
            frames = [env.step({0: action}, render=frozenset({0}))[0].observation for env in (drawn, whole)]
    drawn.close()
    whole.close()


def test_leaving_out_what_the_wrist_cameras_housing_hides_changes_no_pixel() -> None:
    assert_same_frames("RememberColor3-v0", seeds=(1,), n_steps=16)


@pytest.mark.slow
def test_leaving_out_what_the_housing_hides_changes_no_pixel_of_any_task(sampled_task: str) -> None:
    assert_same_frames(sampled_task, seeds=(1, 2), n_steps=60)


def test_the_cue_is_in_the_picture_and_the_parked_cubes_are_not(env: Any) -> None:
    """A pure green, red or blue patch is seen while the cue is shown, none during the delay."""

    def n_pure(image: np.ndarray) -> int:
        channels = np.sort(image.astype(int), axis=2)
        return int(((channels[..., 2] > 150) & (channels[..., 1] < 60)).sum())

    for seed in (1, 2, 3):
        frame = env.reset({0: seed}, render=True)[0].observation
        assert n_pure(frame.images["base_camera"]) > 5
        assert n_pure(frame.images["hand_camera"]) > 20
        for step in range(1, 11):
            is_looked_at = 5 <= step < 10
            rendered = frozenset({0} if is_looked_at else ())
            frame = env.step({0: env.hold_action(0)}, render=rendered)[0].observation
            if is_looked_at:
                assert n_pure(frame.images["base_camera"]) == n_pure(frame.images["hand_camera"]) == 0


def test_the_mugs_hide_the_ball_from_both_cameras() -> None:
    def n_red(image: np.ndarray) -> int:
        red, green, blue = (image[..., i].astype(int) for i in range(3))
        return int(((red > 120) & (green < 60) & (blue < 60)).sum())

    env = make_env(
        EnvSettings(task="ShellGameTouch-v0", cameras=CAMERAS, render=RenderSettings(wrist_mesh="simplified"))
    )
    for seed in range(1, 6):
        frame = env.reset({0: seed}, render=True)[0].observation
        assert n_red(frame.images["base_camera"]) > 0
        assert n_red(frame.images["hand_camera"]) > 0
        for step in range(1, 9):
            rendered = frozenset({0} if step >= 5 else ())
            frame = env.step({0: env.hold_action(0)}, render=rendered)[0].observation
            if rendered:
                assert n_red(frame.images["base_camera"]) == n_red(frame.images["hand_camera"]) == 0


def test_asking_an_environment_without_cameras_for_pictures_is_an_error() -> None:
    blind = make_env(EnvSettings(task="RememberColor3-v0"))
    with pytest.raises(RenderingError, match="made without cameras"):
        blind.reset({0: 1}, render=True)


def test_an_unknown_camera_or_argument_is_named_with_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'hand_camera'"):
        make_env(EnvSettings(task="RememberColor3-v0", cameras=("handcamera",)))
    with pytest.raises(UnknownNameError, match="Did you mean 'delay_steps'"):
        make_env(EnvSettings(task="RememberColor3-v0", kwargs={"delay_step": 3}))


WITHOUT_CAMERAS = """
import os
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import make_env
env = make_env(EnvSettings(task="RememberColor3-v0"))
env.reset({0: 1}, render=False)
os.environ["VK_DRIVER_FILES"] = "/nowhere"  # an instance made from here on would find no driver
env.reset({0: 2}, render=False)
"""


def test_resets_without_cameras_make_no_new_vulkan_instance(tmp_path: Path) -> None:
    done = run_forked(WITHOUT_CAMERAS, tmp_path)  # of a process that has made none
    assert done.returncode == 0, done.stderr
