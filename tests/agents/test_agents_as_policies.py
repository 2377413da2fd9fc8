"""A trained agent is evaluated, held out and compared like any policy; mistakes are one message."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.tiny_agents import BIT, ROBOT, TINY, tiny, trained
from vla_eval.agents.train import train_agent
from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.cli.shared.folders import agent_evaluation
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import HeldOutConfig
from vla_eval.core import EpisodeStart, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.errors import MissingDependencyError, SpecMismatchError, VlaEvalError
from vla_eval.policies.agents.policy import AgentPolicy, make_agent
from vla_eval.policies.context import PolicyContext
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.storage.run_folder import read_run

pytestmark = pytest.mark.usefixtures("in_this_process", "light_workers")


@pytest.fixture(scope="module")
def agents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("agents")
    for algorithm in TINY:
        trained(tiny(algorithm, folder / algorithm))
    trained(tiny("ppo_lstm", folder / "bit", BIT))
    return folder


def evaluated(agent: Path, out: Path, *flags: str, task: str = ROBOT) -> dict[int, tuple[Any, ...]]:
    """Evaluate an agent, and return seed -> what its record says of the episode."""
    fake = () if task.startswith("mikasa_base") else ("--set", "simulator=fake")
    command = ["eval", "--task", task, "--policy", str(agent), "--episodes", "4", "--workers", "1", *fake]
    assert main([*command, *flags, "--out", str(out)]) == 0
    records = read_run(out).records
    assert all(record.error is None for record in records)
    return {record.seed: (record.trajectory_sha256, record.episode_return) for record in records}


@pytest.mark.parametrize("algorithm", [*TINY])
def test_an_agent_is_evaluated_from_its_folder_and_episodes_do_not_share_a_memory(
    algorithm: str, agents: Path, tmp_path: Path
) -> None:
    one = evaluated(agents / algorithm, tmp_path / "one")
    four = evaluated(agents / algorithm, tmp_path / "four", "--set", "slots_per_worker=4")
    assert len(one) == 4 and one == four


@pytest.mark.parametrize("algorithm", [*TINY])
def test_the_memory_of_an_agent_is_complete_and_typed(algorithm: str, agents: Path) -> None:
    simulator = make_env(EnvSettings(task=ROBOT, simulator="fake", privileged=True))
    env, rng = simulator.spec, np.random.default_rng(0)
    frames = [simulator.reset({0: 1}, render=False)[0].observation]
    for _ in range(5):
        action = rng.uniform(-1, 1, len(env.action.dims)).astype(np.float32)
        frames.append(simulator.step({0: action}, render=frozenset())[0].observation)
    context = PolicyContext(name="a", env=env, chunking=ChunkingSpec(n_action_steps=1), n_candidates=3)

    def make() -> AgentPolicy:
        return make_agent(context, checkpoint=str(agents / algorithm))

    policy = make()
    assert policy.spec.has_memory is (algorithm in ("ppo_lstm", "imitation"))

    def acts(policy: AgentPolicy, steps: range) -> list[Any]:
        return [
            policy.act(ObservationWindow(slot=0, frames=(frames[step],))).actions.tolist() for step in steps
        ]

    start = EpisodeStart(slot=0, task=ROBOT, seed=1, run=0, instruction="touch it", horizon_steps=60)
    for n_before in (0, 1, 3):
        policy.reset([start])
        acts(policy, range(n_before))
        memory, other = policy.get_memory(0), make()
        other.reset([start])
        other.set_memory(0, memory)
        assert acts(other, range(n_before, 6)) == acts(policy, range(n_before, 6))
        for name, part in memory.items():
            others = {other: memory[other] for other in memory if other != name}
            wrongs = (others, {**others, f"{name}s": part}, {**others, name: part[0]})
            for wrong in (*wrongs, {**others, name: part.astype(np.float64)}):
                with pytest.raises(SpecMismatchError, match="set_memory: expected"):
                    other.set_memory(0, wrong)


def test_an_agent_of_mikasa_base_is_evaluated_beside_its_controls(
    agents: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluated(agents / "bit", tmp_path / "run", task=BIT)
    said = capsys.readouterr()
    assert "bit-000000048" in said.out
    assert "sentence" not in said.err and "note" not in said.err


def test_an_agent_of_another_control_mode_or_task_is_refused_with_what_it_was_trained_in(
    agents: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = agents / "ppo" / "train/checkpoints/000000048/pretrained_model/config.json"
    about = json.loads(config.read_text())
    changed = tmp_path / "changed"
    changed.mkdir()
    weights = config.with_name("model.safetensors").read_bytes()
    (changed / "model.safetensors").write_bytes(weights)
    changes = {"control_mode": "pd_joint_delta_pos", "env": {"control_mode": "pd_joint_delta_pos"}}
    (changed / "config.json").write_text(json.dumps({**about, **changes}))
    command = ["eval", "--episodes", "1", "--workers", "1", "--set", "simulator=fake"]
    main([*command, "--task", ROBOT, "--policy", str(changed), "--out", str(tmp_path / "a")])
    assert "--set env.control_mode=pd_joint_delta_pos" in _all(capsys)
    main(
        [
            *command,
            "--task",
            "RememberColor9-v0",
            "--policy",
            str(agents / "ppo"),
            "--out",
            str(tmp_path / "b"),
        ]
    )
    assert "inputs: expected" in _all(capsys)


def _all(capsys: pytest.CaptureFixture[str]) -> str:
    said = capsys.readouterr()
    return " ".join((said.out + said.err).split())


@pytest.mark.slow
@pytest.mark.parametrize("task", [pytest.param(ROBOT, marks=pytest.mark.slow), BIT])
def test_checkpoints_are_evaluated_on_held_out_seeds_and_change_nothing(task: str, tmp_path: Path) -> None:
    held_out = HeldOutConfig(every_steps=32, episodes=3, workers=1)
    with_them = trained(tiny("ppo", tmp_path / "with", task, held_out=held_out))
    without = trained(tiny("ppo", tmp_path / "without", task))
    weights = "train/checkpoints/000000048/pretrained_model/model.safetensors"
    assert (with_them / weights).read_bytes() == (without / weights).read_bytes()
    lines = [json.loads(line) for line in (with_them / "metrics.jsonl").open()]
    figures = [line for line in lines if "held_out" in line]
    assert [line["step"] for line in figures] == [32, 48]
    assert all(
        line["n_episodes"] == 3 and "mean_return" in line and "success_once" in line for line in figures
    )
    assert {record.seed for record in read_run(next((with_them / "evaluations").iterdir())).records} == {
        900_000,
        900_001,
        900_002,
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train_agent": {"arguments": {"batch_size": True}}}, "expected a whole number or a number"),
        ({"train_agent": {"reward": "sparse"}, "task": BIT}, "has one reward"),
        ({"train_agent": {"arguments": {"gama": 0.9}}}, "Did you mean 'gamma'"),
        ({"train_agent": {"arguments": {"n_steps": 0}}}, "expected a whole number of steps"),
        ({"train_agent": {"arguments": {"policy_kwargs": "x"}}}, "policy_kwargs"),
        ({"train_agent": {"arguments": {"gamma": "high"}}}, "expected a whole number or a number"),
        ({"train_agent": {"arguments": {"gamma": [0.9]}}}, "expected a whole number or a number"),
        ({"train_agent": {"arguments": {"normalize_advantage": 1}}}, "expected true or false"),
        ({"train_agent": {"network": {"net_arhc": [8]}}}, "Did you mean 'net_arch'"),
        ({"train_agent": {"network": {"net_arch": "wide"}}}, "train_agent"),
        ({"train_agent": {"network": {"activation": "tahn"}}}, "Did you mean 'tanh'"),
        ({"train_agent": {"network": {"lstm_hidden_size": 8}}}, "lstm_hidden_size"),
        ({"policy": "act"}, "no section `train_agent`"),
        ({"policy": "ppoo"}, "Did you mean 'ppo"),
        ({"held_out": HeldOutConfig(every_steps=16, seed_start=50)}, "expected seeds above 100"),
        ({"held_out": HeldOutConfig(every_steps=16, seed_start=999_999)}, "below 1,000,000"),
        ({"held_out": HeldOutConfig(every_steps=16, task="RememberColor5-v0")}, "held_out.task"),
    ],
)
def test_a_mistake_is_refused_before_there_is_a_folder(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    task = changes.pop("task", ROBOT)
    with pytest.raises(VlaEvalError, match=message):
        train_agent(tiny("ppo", tmp_path / "run", task, **changes))
    assert not (tmp_path / "run").exists()


def test_an_algorithm_of_numbers_is_refused_where_actions_are_choices(tmp_path: Path) -> None:
    with pytest.raises(VlaEvalError, match="needs actions that are numbers"):
        train_agent(tiny("sac", tmp_path / "run", BIT, policy="sac"))


@pytest.mark.parametrize(
    ("algorithm", "message"), [("ppo_lsmt", "Did you mean 'ppo_lstm'"), ("tdmpc2", "no package has it")]
)
def test_an_unknown_algorithm_and_one_that_is_left_out_say_so(
    algorithm: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train-agent", "--algorithm", algorithm, "--task", ROBOT]) == 1
    assert message in _all(capsys)


def test_without_the_library_it_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(MissingDependencyError, match="make rl"):
        train_agent(tiny("ppo", tmp_path / "run"))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shapes", {}),
        ("shapes", {"vector": [0]}),
        ("algorithm", "dqn"),
        ("network", {"net_arch": [9]}),
        ("extra", 1),
        ("observation", "everything"),
    ],
)
def test_a_changed_description_of_a_network_is_refused(
    field: str, value: object, agents: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = agents / "ppo" / "train/checkpoints/000000048/pretrained_model"
    folder = tmp_path / "agent"
    folder.mkdir()
    (folder / "model.safetensors").write_bytes((source / "model.safetensors").read_bytes())
    about = {**json.loads((source / "config.json").read_text()), field: value}
    (folder / "config.json").write_text(json.dumps(about))
    command = ["eval", "--task", ROBOT, "--policy", str(folder), "--episodes", "1", "--workers", "1"]
    code = main([*command, "--set", "simulator=fake", "--out", str(tmp_path / "out")])
    said = _all(capsys)
    assert code != 0 and "Traceback" not in said and ("expected" in said or "there is no" in said)


def test_a_dry_run_says_what_it_takes_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vla_eval.agents.dry_run.MEASURED_SECONDS", 0.1)
    command = ["train-agent", "--algorithm", "ppo_lstm", "--task", BIT, "--out", str(tmp_path / "run")]
    assert main([*command, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "weights" in said and "steps/s here" in said
    assert not (tmp_path / "run").exists()


def test_a_network_that_diverges_ends_the_training_and_is_not_saved(tmp_path: Path) -> None:
    fields = {"arguments": {**TINY["ppo"]["arguments"], "learning_rate": 1e30, "max_grad_norm": 1e30}}
    with pytest.raises(VlaEvalError, match="has diverged by step"):
        train_agent(tiny("ppo", tmp_path / "run", train_agent=fields))
    for file in (tmp_path / "run").rglob("model.safetensors"):
        assert all(torch.isfinite(tensor).all() for tensor in load_file(file).values())


def test_arguments_of_a_task_without_a_robot_are_kept(tmp_path: Path) -> None:
    env = {"horizon_steps": 7, "control_mode": "pd_joint_delta_pos"}
    run = trained(tiny("ppo", tmp_path / "run", BIT, train_agent={"env": env, "steps": 16}))
    about = json.loads((run / "train/checkpoints/last/pretrained_model/config.json").read_text())
    assert about["env"] == {"horizon_steps": 7}


def test_the_memory_for_collected_steps_is_said_before(tmp_path: Path) -> None:
    # 8 steps of 2 environments, with images of 6 × 128 × 128 bytes.
    fields = {"observation": "rgb_joints", "steps": 16}
    said: list[str] = []
    train_agent(tiny("ppo", tmp_path / "run", train_agent=fields), say=said.append)
    assert any(line.startswith("memory: 2 MB") for line in said), said


def test_the_command_trains_and_prints_the_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train-agent", "--algorithm", "ppo", "--task", BIT, "--steps", "64", "--n-envs", "2"]
    sizes = [
        "--set",
        "arguments.n_steps=16",
        "--set",
        "arguments.batch_size=16",
        "--set",
        "network.net_arch=[8]",
    ]
    assert main([*command, *sizes, "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr()
    assert said.out.strip().endswith("pretrained_model")
    asks = f"eval --task {BIT} --policy {tmp_path / 'run'} memoryless oracle"
    assert "step 64/64" in said.err and asks in said.err
    assert main(["show", str(tmp_path / "run")]) == 0
    assert asks in _all(capsys)
    assert main([*command, *sizes, "--out", str(tmp_path / "run")]) == 0  # once more: it is finished
    assert "has all of its 64 steps" in _all(capsys)


def test_the_next_command_of_a_robot_s_agent_sets_what_it_was_trained_in(tmp_path: Path) -> None:
    about = {"format_version": 1, "observation": "state", "tasks": [ROBOT], "env": {"delay_steps": 7}}
    (tmp_path / "finetune.json").write_text(json.dumps(about))
    words = agent_evaluation(tmp_path)
    assert words is not None and words[-4:] == ("cue_blind", "oracle", "--set", "env.delay_steps=7")


def test_a_sequence_at_once_is_what_the_library_does_step_by_step() -> None:
    from sb3_contrib.common.recurrent.policies import RecurrentMultiInputActorCriticPolicy as Stepwise

    from vla_eval.policies.agents.lstm import WholeSequences

    rng = torch.Generator().manual_seed(0)
    lstm = torch.nn.LSTM(5, 7, num_layers=2)
    for n_sequences, n_steps in ((1, 1), (3, 1), (1, 6), (4, 9)):
        features = torch.randn(n_sequences * n_steps, 5, generator=rng)
        states = tuple(torch.randn(2, n_sequences, 7, generator=rng) for _ in range(2))
        for start_at in (None, 0, n_steps - 1):
            starts = torch.zeros(n_sequences, n_steps)
            if start_at is not None:
                starts[::2, start_at] = 1
            given = (features, states, starts.reshape(-1), lstm)
            ours, ours_states = WholeSequences._process_sequence(*given)
            theirs, their_states = Stepwise._process_sequence(*given)
            torch.testing.assert_close(ours, theirs)
            for one, other in zip(ours_states, their_states, strict=True):
                torch.testing.assert_close(one, other)


def test_an_agent_with_cameras_is_trained_evaluated_and_served(tmp_path: Path) -> None:
    fields = {"observation": "rgb_joints", "steps": 16}
    agent = trained(tiny("ppo_lstm", tmp_path / "seeing", train_agent=fields))
    assert len(evaluated(agent, tmp_path / "run")) == 4
    hosted = host_policy(HostOptions(policy=str(agent)))
    assert hosted.task == ROBOT and set(hosted.policy.spec.cameras) == {"base_camera", "hand_camera"}


def test_an_agent_that_is_given_true_states_is_not_served(agents: Path) -> None:
    with pytest.raises(SpecMismatchError, match="true state"):
        host_policy(HostOptions(policy=str(agents / "ppo")))
