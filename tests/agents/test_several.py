"""Several trainings of one call: each has its folder, shards part them, one evaluation compares them."""

from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.tiny_agents import BIT, ROBOT
from vla_eval.agents.several import evaluation, in_folders, of_shard
from vla_eval.cli.main import main
from vla_eval.config.agents import AgentConfig, AgentTable
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.storage.run_folder import read_run
from vla_eval.storage.shard import Shard
from vla_eval.tasks.configured import read_configured

pytestmark = pytest.mark.usefixtures("in_this_process", "light_workers")

SIZES = ("n_envs=2", "steps=32", "save_every_steps=16", "arguments.n_steps=8", "arguments.batch_size=8")
TINY = [word for field in (*SIZES, "network.net_arch=[8]") for word in ("--set", field)]


def grid(*tasks: str, policies: tuple[str, ...] = ("ppo_base", "ppo_lstm_base")) -> list[AgentConfig]:
    return [
        AgentConfig(policy=policy, task=task, run_seed=seed)
        for policy in policies
        for task in tasks
        for seed in (0, 1)
    ]


def test_they_are_trained_and_evaluated_together_with_a_run_per_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "agents"
    command = ["train-agent", "--algorithm", "ppo", "ppo_lstm", "--task", BIT, "--run-seed", "0", "1"]
    assert main([*command, *TINY, "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert len(said.out.split()) == 4 and f"eval {out}/eval.yaml --out {out}/evaluation" in said.err
    flags = ["--episodes", "2", "--workers", "1", "--out", str(tmp_path / "run")]
    assert main(["eval", str(out / "eval.yaml"), *flags]) == 0
    counted = {}
    for record in read_run(tmp_path / "run").records:
        counted.setdefault(record.policy, set()).add(record.run)
    assert counted["ppo"] == counted["ppo_lstm"] == {0, 1}
    assert {"random", "memoryless", "oracle"} < counted.keys()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 20])
def test_shards_part_the_trainings(count: int, tmp_path: Path) -> None:
    placed = in_folders(grid(BIT, "mikasa_base/T-Maze-v0"), tmp_path)
    parts = [of_shard(placed, Shard(number=number, count=count)) for number in range(1, count + 1)]
    found = [one for part in parts for one in part]
    assert sorted(found, key=placed.index) == placed
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_each_has_a_folder_of_its_own_and_a_policy_one_entry_per_task(tmp_path: Path) -> None:
    tasks = (BIT, "mikasa_base/T-Maze-v0")
    placed = in_folders(grid(*tasks), tmp_path)
    assert len({one.out for one in placed}) == 8
    config = evaluation(placed)
    assert config.tasks == tasks and len(config.policies) == 4 + 3
    assert all(entry.count(",") == 1 for entry in config.policies[:4])


def test_a_robot_s_agents_are_evaluated_in_what_they_were_trained_in(tmp_path: Path) -> None:
    placed = in_folders(grid(ROBOT, policies=("ppo", "sac")), tmp_path)
    config = evaluation(placed)
    assert config.env == {"control_mode": "pd_joint_delta_pos"} and "cue_blind" in config.policies


@pytest.mark.parametrize(
    ("configs", "message"),
    [
        (grid(BIT, ROBOT), "cannot be evaluated together"),
        ([*grid(BIT), grid(BIT)[0]], "two of these trainings are the same"),
        (
            [*grid(ROBOT, policies=("ppo",)), AgentConfig(policy="sac", task=ROBOT, train_agent={"env": {}})],
            "expected the same for all recipes",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(
    configs: list[AgentConfig], message: str, tmp_path: Path
) -> None:
    with pytest.raises(RecipeError, match=message):
        in_folders(configs, tmp_path)


def test_a_shard_of_one_training_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train-agent", "--algorithm", "ppo", "--task", BIT, "--shard", "1/2"]) == 1
    assert "--shard is for several trainings" in capsys.readouterr().err


@pytest.mark.slow
def test_a_file_of_several_is_each_recipe_task_and_run_seed_and_flags_choose_among_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "table.yaml"
    file.write_text(
        "name: table\npolicies: [ppo_base, ppo_lstm_base]\nrun_seeds: [0, 1]\n"
        "tasks: [mikasa_base/MemoryLengthEasy, mikasa_base/T-Maze]\n"
        "train_agent: {n_envs: 2, steps: 32, save_every_steps: 16, network: {net_arch: [8]}, "
        "arguments: {n_steps: 8, batch_size: 8}}\n"
    )
    out = tmp_path / "out"
    flags = ["--task", BIT, "--policy", "ppo_base", "--out", str(out)]
    assert main(["train-agent", str(file), *flags]) == 0
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == [
        f"ppo_base-mikasa_base-MemoryLengthEasy-v0-{seed}" for seed in (0, 1)
    ]
    capsys.readouterr()
    assert main(["train-agent", str(file), "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "trainings: 8, of which 4 are described" in said
    assert said.count("run folder:") == 4


def test_what_is_different_on_a_task_is_under_what_a_variant_changes() -> None:
    table = AgentTable(
        name="t",
        policies=("imitation",),
        tasks=("A-v0", "B-v0"),
        train_agent={"steps": 10, "arguments": {"batch_size": 2, "exchange_share": 0.0}},
        of_tasks={"B-v0": {"steps": 20, "arguments": {"exchange_share": 0.5}}},
        variants={"small": {"network": {"width": 4}}, "short": {"steps": 5}},
    )
    assert table.of("A-v0", "small")["train_agent"] == {
        "steps": 10,
        "arguments": {"batch_size": 2, "exchange_share": 0.0},
        "network": {"width": 4},
    }
    several = {"batch_size": 2, "exchange_share": 0.5}
    assert table.of("B-v0", "small")["train_agent"]["arguments"] == several
    assert table.of("B-v0", "small")["train_agent"]["steps"] == 20
    assert table.of("B-v0", "short")["train_agent"] == {"steps": 5, "arguments": several}
    assert table.of("C-v0", "short")["train_agent"]["steps"] == 5  # named by a flag


def test_what_is_different_on_a_task_that_is_not_there_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "table.yaml"
    fields = "name: t\npolicies: [ppo_base]\ntasks: [mikasa_base/T-Maze]\nof_tasks: "
    file.write_text(fields + "{mikasa_base/T-Maze: {steps: 7}}")  # both get their version
    table = read_configured(AgentTable, str(file), folder="configs")
    assert table.of(table.tasks[0], None)["train_agent"] == {"steps": 7}
    file.write_text(fields + "{mikasa_base/T-Maz-v0: {steps: 7}}")
    with pytest.raises(UnknownNameError, match=r"of_tasks.*Did you mean 'mikasa_base/T-Maze-v0'"):
        read_configured(AgentTable, str(file), folder="configs")


def test_a_file_of_trainings_is_not_evaluated(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "base_table"]) == 1
    assert "Run `mikasa-vla train-agent base_table`" in capsys.readouterr().err


@pytest.mark.parametrize("field", ["policies", "tasks", "run_seeds"])
@pytest.mark.parametrize("value", ["[]", "twice"])
def test_a_file_of_none_or_of_one_twice_is_refused(
    tmp_path: Path, field: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = {"policies": "[ppo_base]", "tasks": f"[{BIT}]", "run_seeds": "[0]"}
    one = fields[field].strip("[]")
    fields[field] = "[]" if value == "[]" else f"[{one}, {one}]"
    file = tmp_path / "table.yaml"
    file.write_text("\n".join(["name: t", *(f"{name}: {text}" for name, text in fields.items())]))

    assert main(["train-agent", str(file)]) == 1
    assert f"{field} is" in capsys.readouterr().err
