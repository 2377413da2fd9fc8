"""A table of learned policies with tiny random models: every row, in one run or in shards."""

import json
from pathlib import Path

import pytest
import yaml

from tests.evaluation import test_model_table
from tests.evaluation.test_model_table import PAPER, TASK
from vla_eval.cli.main import main
from vla_eval.evaluation.model_table import load_model_table

pytestmark = pytest.mark.usefixtures("in_this_process")
cache_of_its_own = test_model_table.cache_of_its_own
small = test_model_table.small


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tasks", "left_out"),
    [
        ([TASK], ("memoryless", "diffusion")),
        pytest.param([TASK, "InterceptMedium-v0"], (), marks=pytest.mark.slow),
    ],
)
def test_small_policies_come_to_a_table_at_several_numbers_of_action_steps(
    tasks: list[str], left_out: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = yaml.safe_load(Path("configs/memory_table.yaml").read_text(encoding="utf-8"))
    data["tasks"] = tasks
    for row in data["rows"]:
        row["tasks"] = [task for task in row.get("tasks", tasks) if task in tasks]
        row["n_action_steps"] = [4, 8]
    data["rows"] = [row for row in data["rows"] if row["tasks"] and row["name"] not in left_out]
    path = tmp_path / "memory.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert main(["eval", str(path), "--tiny", "--format", "json", "--out", str(tmp_path / "out")]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    controls = ["random", "cue_blind", "oracle"]
    policies = {
        TASK: [*controls, "memory", "memoryless", "diffusion"],
        "InterceptMedium-v0": [*controls, "memory_free", "memoryless_free", "diffusion"],
    }
    assert {(row["task"], row["policy"], row["n_action_steps"]) for row in rows} == {
        (task, name, steps)
        for task in tasks
        for name in policies[task]
        for steps in (4, 8)
        if name not in left_out
    }
    assert all(row["n_episodes"] == 2 and row["n_errors"] == 0 for row in rows)


@pytest.mark.slow
def test_shards_of_a_table_merge_into_its_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = yaml.safe_load(Path("configs/memory_table.yaml").read_text(encoding="utf-8"))
    row = {"name": "memory", "policy": "memory", "n_action_steps": [8]}
    data |= {"tasks": [TASK], "rows": [row], "controls": ["cue_blind"], "run_seeds": [0]}
    path, out = tmp_path / "memory.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    command = ["eval", str(path), "--tiny", "--format", "json", "--out", str(out)]
    for number in (1, 2):
        assert main([*command, "--shard", f"{number}/2"]) == 0
        assert json.loads(capsys.readouterr().out)["rows"][0]["n_episodes"] == 1  # of two
    shards = [str(out / f"evaluation-shard-{number}-of-2") for number in (1, 2)]
    assert main(["merge", *shards, "--out", str(out / "evaluation")]) == 0
    capsys.readouterr()

    assert main(command) == 0
    merged = capsys.readouterr()
    assert merged.err.count("all 2 episodes are there") == 2  # the row's folder and the controls'
    (out / "evaluation").rename(tmp_path / "merged")
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == json.loads(merged.out)["rows"]
    for folder in (tmp_path / "merged").iterdir():
        lines, of_one = (
            sorted((place / folder.name / "episodes.jsonl").read_text().splitlines())
            for place in (tmp_path / "merged", out / "evaluation")
        )
        assert len(lines) == 2 and lines == of_one


@pytest.mark.slow
def test_with_tiny_models_it_prints_every_row_beside_controls_and_the_papers_figures(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["eval", str(small), "--tiny", "--paper", "--format", "json", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    first = capsys.readouterr()
    told = json.loads(first.out)
    rows = {(row["policy"], row["n_action_steps"]) for row in told["rows"]}
    models = {(row.name, row.n_action_steps[0]) for row in load_model_table(PAPER).rows}
    controls = {(name, n) for name in ("random", "cue_blind", "oracle") for n in (4, 8)}
    assert rows == models | controls
    assert len(told["paper"]["rows"]) == 5
    assert "mean nothing" in first.err

    assert main(arguments) == 0  # everything is there
    again = capsys.readouterr()
    assert json.loads(again.out) == told and "[1/" not in again.err
