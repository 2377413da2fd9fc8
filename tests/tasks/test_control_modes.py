"""Control modes: bounds, holding, freezing and experts are right in each; images have the size asked for."""

from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POS, EE_DELTA_POSE, EE_POSE, JOINT_POS
from vla_eval.core import EpisodeStart, FloatArray
from vla_eval.envs.factory import make_env
from vla_eval.errors import SpecMismatchError, TaskArgumentError, UnknownNameError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.arm import drives
from vla_eval.tasks.catalog import task_spec
from vla_eval.testing.check_env import check_env

TASK = "RememberColor3-v0"
MODES = tuple(CONTROL_MODES)
FETCH = {"robot": "fetch"}
BEFORE_THE_CHOICE = ("freeze_until_choice", "move_in_delay")


def env_in(mode: str, task: str = TASK, **kwargs: Any) -> Any:
    return make_env(EnvSettings(task=task, kwargs={"control_mode": mode, **kwargs}, privileged=True))


@pytest.mark.parametrize("mode", MODES)
def test_names_and_bounds_of_an_action_are_those_of_the_simulator_s_controller(mode: str) -> None:
    env = env_in(mode)
    space = env._envs[0].single_action_space
    assert space.low.tolist() == list(env.spec.action.low) and space.high.tolist() == list(
        env.spec.action.high
    )
    assert len(env.spec.action.dims) == space.shape[0]
    assert env.spec == offered_by(task_spec(TASK), {"control_mode": mode})


@pytest.mark.parametrize("mode", MODES[1:])
def test_an_environment_in_another_mode_keeps_the_contract(mode: str) -> None:
    check_env(lambda: env_in(mode), renders=False, n_steps=4)


@pytest.mark.parametrize(("mode", "other_arm"), [*((mode, {}) for mode in MODES), (EE_DELTA_POSE, FETCH)])
def test_the_arm_moves_as_with_maniskill_s_own_controllers_to_the_last_bit(
    mode: str, other_arm: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Also beyond the bounds, where numbers are clipped and rotations shortened.
    space, n_steps = CONTROL_MODES[mode], 40
    drawn = np.random.default_rng(0).uniform(space.low, space.high, (n_steps, len(space.dims))) * 1.5
    states = []
    known, kept, make_own = tuple(drives.DRIVES), [], drives._own_drive

    def own(controller: Any) -> Any:
        kept.extend([controller] if isinstance(controller, known) else ())
        return make_own(controller)

    monkeypatch.setattr(drives, "_own_drive", own)
    for table in (drives.DRIVES, {}):  # without a row, a controller keeps ManiSkill's own way
        monkeypatch.setattr(drives, "DRIVES", table)
        env = env_in(mode, **other_arm)
        env.reset({0: 5}, render=False)
        actions = drawn.copy()
        if mode == EE_POSE:  # every other pose is one that the arm can reach
            actions[::2] = env.hold_action(0) + actions[::2] / 50
        results = [env.step({0: action.astype(np.float32)}, render=frozenset())[0] for action in actions]
        states.append([result.observation.state[name] for result in results for name in ("qpos", "qvel")])
        states[-1].append(env.joint_targets(0))
        env.close()
        assert bool(kept) == (not table), "a mode was compared with itself"
    np.testing.assert_equal(states[0], states[1])
    assert np.ptp(states[0][:-1:2], axis=0).max() > 0.1, "the arm did not move"


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("mode", "arguments"),
    [*((mode, {}) for mode in MODES), *((EE_DELTA_POSE, {event: True}) for event in BEFORE_THE_CHOICE)],
)
def test_arms_that_step_together_move_as_each_does_alone_to_the_last_bit(
    mode: str, arguments: dict[str, bool]
) -> None:
    space, n_slots, n_steps = CONTROL_MODES[mode], 3, 25
    drawn = np.random.default_rng(1).uniform(space.low, space.high, (n_steps, n_slots, len(space.dims)))
    actions = (drawn * 1.2).astype(np.float32)
    actions[:, :, :3] *= np.array([1, 0.1, 0], dtype=np.float32)[:, None]  # long, short, no translation

    def states(slots: tuple[int, ...]) -> dict[int, list[FloatArray]]:
        env: Any = make_env(
            EnvSettings(task=TASK, kwargs={"control_mode": mode, **arguments}, n_slots=n_slots)
        )
        env.reset({slot: 5 + slot for slot in slots}, render=False)
        found: dict[int, list[FloatArray]] = {slot: [] for slot in slots}
        for step in range(n_steps):
            # The last episode ends before the others.
            going = [slot for slot in slots if slot < n_slots - 1 or step < n_steps // 2]
            asked = {slot: actions[step, slot] for slot in going}
            for slot, result in env.step(asked, render=frozenset()).items():
                found[slot] += [*result.observation.state.values(), env.joint_targets(slot)]
        env.close()
        return found

    together = states((0, 1, 2))
    np.testing.assert_equal(together, states((0,)) | states((1,)) | states((2,)))
    assert not np.array_equal(together[0][0], together[1][0])


@pytest.mark.parametrize("mode", MODES)
def test_the_arm_stays_where_it_is_while_frozen_whatever_the_action_and_while_held(mode: str) -> None:
    env = env_in(mode, freeze_until_choice=True, cue_steps=2, delay_steps=2)
    before = env.reset({0: 3}, render=False)[0].observation.state["qpos"]
    away = np.array(env.spec.action.high, dtype=np.float32)
    away[-1] = -1.0  # would close the gripper
    for _ in range(4):
        frozen = env.step({0: away}, render=frozenset())[0]
        assert frozen.executed_action is not None
        assert not np.array_equal(frozen.executed_action, away)
    held = env.step({0: env.hold_action(0)}, render=frozenset())[0]
    np.testing.assert_allclose(held.observation.state["qpos"], before, atol=1e-4)
    moved = env.step({0: away}, render=frozenset())[0]
    assert moved.observation.state["qpos"][-1] < before[-1] - 0.001  # the choice has begun: it closes


def test_what_is_beyond_the_joints_limits_is_clipped_and_executed_as_clipped() -> None:
    env = env_in(JOINT_POS)
    env.reset({0: 1}, render=False)
    beyond = np.full(8, 100.0, dtype=np.float32)
    executed = env.step({0: beyond}, render=frozenset())[0].executed_action
    np.testing.assert_array_equal(executed, np.float32(CONTROL_MODES[JOINT_POS].high))


@pytest.mark.parametrize(("mode", "n_action_steps"), [*((mode, 1) for mode in MODES[1:]), (JOINT_POS, 8)])
def test_the_expert_touches_the_right_cube_in_every_mode(mode: str, n_action_steps: int) -> None:
    env, chunking = env_in(mode), ChunkingSpec(n_action_steps=n_action_steps)
    policy = make_oracle(PolicyContext(name="oracle", env=env.spec, chunking=chunking, n_candidates=3))
    start = EpisodeStart(slot=0, task=TASK, seed=2, run=0, instruction="touch it", horizon_steps=60)
    settings = RolloutSettings(chunking=chunking, stop_at_success=True)
    (record,) = rollout(env, policy, [start], settings)
    assert record.outcome == "success"


def test_an_expert_that_turns_the_wrist_refuses_a_mode_without_rotation() -> None:
    task = "RotateLenientPos-v0"
    env = env_in(EE_DELTA_POS, task)
    context = PolicyContext(
        name="oracle", env=env.spec, chunking=ChunkingSpec(n_action_steps=1), n_candidates=0
    )
    with pytest.raises(SpecMismatchError, match=r"RotateLenientPos-v0 turns the wrist, and the control mode"):
        make_oracle(context)


def test_a_mistyped_mode_a_motion_it_cannot_make_and_another_arm_are_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"pd_join_pos.*Did you mean 'pd_joint_pos'"):
        env_in("pd_join_pos")
    with pytest.raises(TaskArgumentError, match=r"move_in_delay with control_mode='pd_joint_pos'"):
        env_in(JOINT_POS, move_in_delay=True)
    with pytest.raises(TaskArgumentError, match=r"control_mode='pd_joint_pos' with robot_uids='fetch_at"):
        env_in(JOINT_POS, robot_uids="fetch_at_table")
    with pytest.raises(TaskArgumentError, match=r"the fake simulator has no joints"):
        make_env(EnvSettings(task=TASK, kwargs={"control_mode": JOINT_POS}, simulator="fake"))


@pytest.mark.parametrize(
    ("size", "expected"),
    [(15, "16 to 2048 pixels"), (2049, "16 to 2048 pixels")]
    + [(size, "a whole number") for size in ("256", True, 64.0)],
)
def test_an_impossible_image_size_is_refused(size: object, expected: str) -> None:
    with pytest.raises(TaskArgumentError, match=f"image_size.*: expected {expected}"):
        env_in(EE_DELTA_POSE, image_size=size)


@pytest.mark.parametrize("simulator", ["maniskill", "fake"])
def test_both_cameras_have_the_size_that_is_asked_for(simulator: Any) -> None:
    settings = EnvSettings(
        task=TASK,
        kwargs={"image_size": 48},
        simulator=simulator,
        cameras=("base_camera", "hand_camera"),
    )
    env = make_env(settings)
    images = env.reset({0: 1}, render=True)[0].observation.images
    assert {name: image.shape for name, image in images.items()} == {
        camera.name: (camera.height_px, camera.width_px, 3) for camera in env.spec.cameras
    }
    assert {camera.height_px for camera in env.spec.cameras} == {48}
