"""PPO on the true state: learns, can be continued bit for bit, and becomes a policy."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from vla_eval.cli.main import main
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.envs.settings import EnvSettings
from vla_eval.errors import CheckpointError, SimulationError, SpecMismatchError, UnknownNameError
from vla_eval.policies.chunking import ChunkingSpec
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.ppo_expert import make_ppo_expert
from vla_eval.registry import policy_factory
from vla_eval.task_state import PrivilegedState
from vla_eval.training.lockstep import LockstepEnvs, LockstepResult, distance_to_go_m
from vla_eval.training.ppo_expert import _Learner, advantages_of, train_expert
from vla_eval.training.ppo_network import ActorCritic, NetworkSpec
from vla_eval.training.ppo_settings import PpoSettings

TASK = "RememberColor3-v0"
SETTINGS = PpoSettings(
    task=TASK, simulator="fake", env_kwargs={"horizon_steps": 12}, n_envs=4, n_epochs=2, hidden=(16,)
)
STEPS_PER_ITERATION = 4 * 12


def weights(out: Path) -> dict[str, torch.Tensor]:
    return load_file(out / "expert.safetensors")


def assert_same_weights(a: Path, b: Path) -> None:
    first, second = weights(a), weights(b)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("expert") / "uninterrupted"
    train_expert(SETTINGS, n_steps=4 * STEPS_PER_ITERATION, out=out)
    return out


class Bandit:
    """Environments whose reward is highest where the first action is 0.5, and that know no other state."""

    def reset(self, seeds: Any) -> LockstepResult:
        return self.step(np.zeros((len(seeds), 7), dtype=np.float32))

    def step(self, actions: Any) -> LockstepResult:
        rewards = -np.abs(actions[:, 0] - 0.5).astype(np.float32)
        states, nothing = np.ones((len(actions), 3), np.float32), np.zeros(len(actions), np.float32)
        return LockstepResult(states, rewards, rewards > -0.05, nothing)


@pytest.mark.slow
def test_it_learns() -> None:
    learner = _Learner(dataclasses.replace(SETTINGS, n_envs=32, n_epochs=8), n_state=3)
    rewards = []
    for _ in range(30):
        rollout = learner.collect(Bandit(), 6)  # type: ignore[arg-type]  # all that it asks for
        learner.learn(rollout)
        rewards.append(rollout.mean_reward)

    # At first actions are N(0, 0.4²): E|a - 0.5| ≈ 0.54; around 0.5 it is 0.4 √(2/π) = 0.32.
    assert rewards[0] < -0.45
    assert rewards[-1] > -0.33


def test_coming_nearer_is_rewarded_while_learning() -> None:
    class Approach(Bandit):
        """One metre away at reset, a quarter nearer at each step, without any reward."""

        def reset(self, seeds: Any) -> LockstepResult:
            self.to_go_m = 1.25
            return super().reset(seeds)

        def step(self, actions: Any) -> LockstepResult:
            self.to_go_m -= 0.25
            to_go = np.full(len(actions), self.to_go_m, np.float32)
            return super().step(actions)._replace(rewards_N=np.zeros_like(to_go), to_go_N=to_go)

    settings = dataclasses.replace(SETTINGS, discount=0.9, shaping_per_m=2.0)
    rollout = _Learner(settings, n_state=3).collect(Approach(), 2)  # type: ignore[arg-type]

    # A quarter of a metre per step at 2 per metre. Reported is the reward without it.
    assert rollout.rewards_TN[:, 0].tolist() == pytest.approx([0.5, 0.5])
    assert rollout.mean_reward == 0


def test_the_distance_to_go_is_that_of_the_arm_and_of_the_ball() -> None:
    def privileged(task: str) -> PrivilegedState:
        env = make_env(EnvSettings(task=task, simulator="fake", privileged=True))
        world = env.reset({0: 1}, render=False)[0].observation.privileged
        assert world is not None
        return world

    choice = privileged(TASK)
    assert choice.target is not None
    to_cube = choice.candidate_positions_m[choice.target] - choice.tcp_position_m
    assert distance_to_go_m(choice) == pytest.approx(math.sqrt(sum(to_cube**2)))
    rolling = privileged("InterceptMedium-v0")
    ball, goal = rolling.bodies["ball"].position_m, rolling.bodies["goal"].position_m
    expected = math.dist(ball, rolling.tcp_position_m) + math.dist(ball[:2], goal[:2])
    assert distance_to_go_m(rolling) == pytest.approx(expected)


def test_advantages_are_the_weighted_sum_of_errors() -> None:
    rewards, values = torch.rand(5, 2), torch.rand(6, 2)
    discount, gae_lambda = 0.8, 0.9

    found = advantages_of(rewards, values, discount=discount, gae_lambda=gae_lambda)

    errors = rewards + discount * values[1:] - values[:-1]
    for step in range(5):
        expected = sum((discount * gae_lambda) ** k * errors[step + k] for k in range(5 - step))
        assert torch.allclose(found[step], torch.as_tensor(expected), atol=1e-6)


def test_the_running_normalisation_is_that_of_all_states_together() -> None:
    network = ActorCritic(NetworkSpec(n_state=2, n_action=7))
    parts = [torch.randn(50, 2) * 0.3 + 0.2, torch.randn(30, 2) * 0.1]
    for part in parts:
        network.observe(part)

    together = torch.cat(parts)
    assert torch.allclose(network.mean, together.mean(0), atol=1e-4)
    assert torch.allclose(network.variance, together.var(0, unbiased=False), atol=1e-4)


def test_learned_dimensions_go_to_their_places_and_the_others_are_held() -> None:
    settings = dataclasses.replace(SETTINGS, learned_dims=("gripper", "dy"), held_gripper=0.5)
    assert settings.full_actions(np.array([[-1.0, 0.3]], np.float32))[0] == pytest.approx(
        [0, 0.3, 0, 0, 0, 0, -1]
    )
    assert SETTINGS.full_actions(np.zeros((1, 3), np.float32))[0, 6] == 1
    with pytest.raises(UnknownNameError, match="Did you mean 'dx'"):
        dataclasses.replace(SETTINGS, learned_dims=("ddx",))


def test_an_object_that_is_parked_far_away_does_not_blind_the_network() -> None:
    network = ActorCritic(NetworkSpec(n_state=1, n_action=7))
    # An object on the table for nine tenths of the time, otherwise parked at 150 m.
    states = torch.cat([torch.linspace(-0.1, 0.1, 90), torch.full((10,), 150.0)])[:, None]
    network.observe(states)

    spread = network.normalize(torch.tensor([[-0.1], [0.1]])).flatten()
    # Uniform over 0.2 m the standard deviation is 0.058 m, and a little less with zeros for the absent: the
    # ends are more than 3 apart. With 150 m in it, it would be 45 m, and the ends 0.004 apart.
    assert float(spread[1] - spread[0]) > 3


def test_a_continued_training_is_the_uninterrupted_one(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "continued"
    train_expert(SETTINGS, n_steps=2 * STEPS_PER_ITERATION, out=out)
    progress = train_expert(SETTINGS, n_steps=4 * STEPS_PER_ITERATION, out=out)

    assert progress.n_steps == 4 * STEPS_PER_ITERATION
    assert_same_weights(out, trained)
    lines = [json.loads(line)["n_steps"] for line in (out / "progress.jsonl").read_text().splitlines()]
    assert lines == [48, 96, 144, 192]


def test_the_number_of_processes_changes_nothing(trained: Path, tmp_path: Path) -> None:
    train_expert(SETTINGS, n_steps=4 * STEPS_PER_ITERATION, out=tmp_path / "three", n_workers=3)

    assert_same_weights(tmp_path / "three", trained)


def test_another_seed_learns_something_else(trained: Path, tmp_path: Path) -> None:
    other = dataclasses.replace(SETTINGS, seed=1)
    train_expert(other, n_steps=STEPS_PER_ITERATION, out=tmp_path / "other")

    assert not torch.equal(
        weights(tmp_path / "other")["network.actor.0.weight"], weights(trained)["network.actor.0.weight"]
    )


def test_a_finished_training_is_not_repeated(trained: Path) -> None:
    before = (trained / "expert.safetensors").read_bytes()
    progress = train_expert(SETTINGS, n_steps=STEPS_PER_ITERATION, out=trained)

    assert progress.n_steps == 4 * STEPS_PER_ITERATION
    assert (trained / "expert.safetensors").read_bytes() == before


def test_training_stops_when_it_is_asked_to_and_keeps_what_it_has(tmp_path: Path) -> None:
    train_expert(SETTINGS, n_steps=10**6, out=tmp_path / "out", on_progress=lambda _: True)

    assert train_expert(SETTINGS, n_steps=1, out=tmp_path / "out").n_steps == STEPS_PER_ITERATION


def test_other_settings_do_not_go_into_the_same_folder(trained: Path) -> None:
    other = dataclasses.replace(SETTINGS, learning_rate=0.5, seed=3)

    with pytest.raises(CheckpointError, match="a training with another seed, learning_rate"):
        train_expert(other, n_steps=1, out=trained)


def context(task: str = TASK) -> PolicyContext:
    env = make_env(EnvSettings(task=task, simulator="fake"))
    return PolicyContext(
        name="learned", env=env.spec, chunking=ChunkingSpec(n_action_steps=1), n_candidates=3
    )


def window(state: Any) -> ObservationWindow:
    env = make_env(EnvSettings(task=TASK, simulator="fake", privileged=True))
    observation = env.reset({0: 1}, render=False)[0].observation
    privileged = None
    if state is not None and observation.privileged is not None:
        privileged = dataclasses.replace(observation.privileged, state_vector=state)
    frame = Observation(step=0, images={}, state={}, privileged=privileged)
    return ObservationWindow(slot=0, frames=(frame,))


class TestThePolicy:
    def test_it_is_the_networks_most_likely_action(self, trained: Path) -> None:
        policy = policy_factory("ppo_expert")(context(), checkpoint=str(trained))
        start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="", horizon_steps=12)
        policy.reset([start])
        state = np.linspace(-0.3, 0.3, 10, dtype=np.float32)

        chunk = policy.act(window(state))

        stored = weights(trained)
        mean, variance = stored["network.mean"], stored["network.variance"]
        normalized = ((torch.from_numpy(state) - mean) / torch.sqrt(variance + 1e-8)).clamp(-10, 10)
        inner = torch.tanh(stored["network.actor.0.weight"] @ normalized + stored["network.actor.0.bias"])
        expected = stored["network.actor.2.weight"] @ inner + stored["network.actor.2.bias"]
        # Rotation is held at 0 and the gripper open.
        whole = [*expected.clamp(-1, 1).tolist(), 0, 0, 0, 1]
        assert chunk.actions.shape == (1, 7)
        assert chunk.actions[0] == pytest.approx(whole, abs=1e-6)
        assert policy.spec.privileged and policy.spec.cameras == ()

    def test_another_task_is_refused(self, trained: Path) -> None:
        with pytest.raises(CheckpointError, match="is an expert for RememberColor3-v0, expected"):
            make_ppo_expert(context("InterceptMedium-v0"), checkpoint=str(trained))

    @pytest.mark.parametrize(("state", "found"), [(np.zeros(4, np.float32), 4), (None, 0)])
    def test_another_state_is_refused(self, trained: Path, state: Any, found: int) -> None:
        policy = make_ppo_expert(context(), checkpoint=str(trained))

        with pytest.raises(SpecMismatchError, match=f"trained on 10 numbers .* offers {found}"):
            policy.act(window(state))

    def test_no_checkpoint(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no training of an expert"):
            make_ppo_expert(context(), checkpoint=str(tmp_path))

    def test_a_damaged_checkpoint(self, trained: Path, tmp_path: Path) -> None:
        (tmp_path / "config.json").write_bytes((trained / "config.json").read_bytes())
        (tmp_path / "expert.safetensors").write_bytes(b"\x80\x04pickle")

        with pytest.raises(CheckpointError, match=r"expert.safetensors: cannot be read"):
            make_ppo_expert(context(), checkpoint=str(tmp_path))


def test_a_mistake_inside_a_process_is_told_outside() -> None:
    settings = EnvSettings(task=TASK, simulator="fake", kwargs={"n_itms": 3}, privileged=True)

    with (
        pytest.raises(UnknownNameError, match="Did you mean 'n_items'"),
        LockstepEnvs(settings, n_envs=2, n_workers=2),
    ):
        pass


def test_a_process_that_dies_is_an_error_and_not_a_wait() -> None:
    settings = EnvSettings(task=TASK, simulator="fake", privileged=True)

    with LockstepEnvs(settings, n_envs=2, n_workers=2) as envs:
        envs.reset([1, 2])
        envs._processes[1].kill()
        with pytest.raises(SimulationError, match="process has died"):
            for _ in range(3):
                envs.step(np.zeros((2, 7), dtype=np.float32))


def test_the_command_line_trains_and_the_policy_can_be_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "expert"
    arguments = ["train-expert", "--task", TASK, "--steps", "60", "--out", str(out)]
    assert main([*arguments, "--simulator", "fake", "--envs", "2"]) == 0
    shown = capsys.readouterr()
    # Two environments of 60 steps are 120 ≥ 60.
    assert "120 steps" in shown.out and "120/60 steps after" in shown.err

    policy = str(out / "ppo_expert.yaml")
    code = main(
        [
            *("eval", "--task", TASK, "--policy", policy, "--episodes", "2", "--workers", "1"),
            *("--set", "simulator=fake", "--out", str(tmp_path / "run")),
        ]
    )

    assert code == 0
    assert "ppo_expert" in capsys.readouterr().out


@pytest.mark.parametrize("task", [TASK, "ShellGameTouch-v0", "InterceptMedium-v0"])
def test_the_state_vector_is_maniskills_own_state_observation(task: str) -> None:
    from vla_eval.tasks.catalog import task_spec
    from vla_eval.tasks.register import env_class

    spec = task_spec(task)
    ours = make_env(EnvSettings(task=task, privileged=True))
    theirs = env_class(spec)(
        num_envs=1, obs_mode="state", render_backend="none", control_mode="pd_ee_delta_pose", **spec.kwargs
    )
    observed = ours.reset({0: 5}, render=False)[0].observation.privileged
    expected, _ = theirs.reset(seed=5)

    assert observed is not None
    assert np.array_equal(observed.state_vector, expected[0].numpy())
    ours.close()
    theirs.close()
