"""Shards of an evaluation on the fake simulator: disjoint, resumed, together the same lines as one run."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import TASK, Bench
from tests.evaluation.resolved import evaluate, evaluation_effort
from vla_eval.cli.main import main
from vla_eval.errors import RecipeError, RunChangedError
from vla_eval.results.report import build_table
from vla_eval.storage.merging import merge_runs, write_merged
from vla_eval.storage.run_folder import read_run
from vla_eval.storage.shard import Shard

pytestmark = pytest.mark.usefixtures("light_workers")

bench = evaluation_bench.bench

# 7 seeds in blocks of 2: 1 2 | 3 4 | 5 6 | 7. Dealt out in turn to two shards.
SEEDS_OF = {1: {1, 2, 5, 6}, 2: {3, 4, 7}}


def run_shards(bench: Bench, count: int, **fields: Any) -> list[Path]:
    folders = []
    for number in range(1, count + 1):
        folders.append(bench.folder / f"shard-{number}")
        evaluate(bench.config(**fields), out=folders[-1], shard=Shard(number=number, count=count))
    return folders


def test_four_shards_merged_have_the_lines_and_the_table_of_one_run(bench: Bench) -> None:
    bench.run("one", runs=2)
    merged = merge_runs(run_shards(bench, 4, runs=2))
    write_merged(merged, bench.folder / "merged")

    # 2 runs × 6 seeds
    assert len(bench.lines("one")) == 12
    assert bench.lines("merged") == bench.lines("one")
    one, whole = (read_run(bench.folder / name) for name in ("one", "merged"))
    assert whole.description.config == one.description.config
    assert whole.description.recipes == one.description.recipes
    assert build_table([whole]).rows == build_table([one]).rows


def test_shards_in_one_report_give_the_table_of_one_run_without_a_note_of_missing_episodes(
    bench: Bench,
) -> None:
    bench.run("one")
    shards = [read_run(folder) for folder in run_shards(bench, 3)]

    one, table = build_table([read_run(bench.folder / "one")]), build_table(shards)

    assert table.rows == one.rows
    assert not any("complete" in note for note in table.notes)
    assert any("not in this table: shard 2/3" in note for note in build_table([shards[0], shards[2]]).notes)


def test_episodes_that_run_side_by_side_stay_together_in_their_rows(bench: Bench) -> None:
    bench.write_policy("pair_policy:make")
    run_shards(bench, 2, episodes=7, slots_per_worker=2)

    found = {number: set(bench.records(f"shard-{number}")) for number in (1, 2)}
    assert found == SEEDS_OF
    rows = (bench.folder / "rows").read_text().splitlines()
    assert rows == ["1:0 2:1", "5:0 6:1", "3:0 4:1", "7:0"]


def test_all_episodes_of_a_seed_are_in_one_shard(bench: Bench) -> None:
    fields: dict[str, Any] = {"policies": ["random", "hold"], "runs": 2}
    (first, second) = (read_run(folder).records for folder in run_shards(bench, 2, **fields))

    assert {record.seed for record in first} == {1, 3, 5}
    assert {record.seed for record in second} == {2, 4, 6}
    # 2 policies × 2 runs × 3 seeds
    assert len(first) == len(second) == 12


def test_the_shard_is_in_run_json_and_another_one_does_not_continue_it(bench: Bench) -> None:
    config = bench.config()
    evaluate(config, out=bench.folder / "out", shard=Shard(number=1, count=2))

    stored = json.loads((bench.folder / "out/run.json").read_text())["shard"]
    assert (stored["number"], stored["count"], stored["block_size"]) == (1, 2, 1)
    with pytest.raises(RunChangedError, match=r"shard.number: 1 -> 2"):
        evaluate(config, out=bench.folder / "out", shard=Shard(number=2, count=2))
    with pytest.raises(RunChangedError, match=r"shard.number: 1 -> \(not set\)"):
        evaluate(config, out=bench.folder / "out")


def test_a_whole_run_has_no_field_of_a_shard(bench: Bench) -> None:
    bench.run("out", episodes=1)

    assert "shard" not in json.loads((bench.folder / "out/run.json").read_text())


def test_a_shard_that_was_stopped_is_resumed(bench: Bench) -> None:
    (folder, _) = run_shards(bench, 2)
    lines = (folder / "episodes.jsonl").read_text().splitlines(keepends=True)
    (folder / "episodes.jsonl").write_text(lines[0])

    summary = evaluate(bench.config(), out=folder, shard=Shard(number=1, count=2))

    assert (summary.n_episodes, summary.n_open) == (3, 0)
    assert sorted((folder / "episodes.jsonl").read_text().splitlines()) == sorted(
        line.rstrip("\n") for line in lines
    )


def test_more_shards_than_episodes_that_can_be_apart_are_refused(bench: Bench) -> None:
    with pytest.raises(RecipeError, match="expected at most 6 shards, since there are 6 episodes"):
        evaluate(bench.config(), out=bench.folder / "out", shard=Shard(number=1, count=7))
    with pytest.raises(RecipeError, match=r"at most 3 shards.* 2 of which stay together"):
        evaluate(bench.config(slots_per_worker=2), out=bench.folder / "out", shard=Shard(number=1, count=4))
    assert not (bench.folder / "out").exists()


def test_what_is_left_of_a_shard_is_its_own_episodes(bench: Bench) -> None:
    config, shard = bench.config(runs=2), Shard(number=2, count=4)

    effort = evaluation_effort(config, out=bench.folder / "out", shard=shard)

    # Of 6 seeds in blocks of one, shard 2 of 4 has the second and the last: 2 seeds × 2 runs.
    assert effort.n_episodes == 4


class TestCommandLine:
    @pytest.mark.parametrize("text", ["3", "0/4", "5/4", "a/b", "1/0", "1/2/3", "-1/4", "٣/٤"])
    def test_a_mistyped_shard_is_a_mistake(self, text: str, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as stopped:
            main(["eval", "demo", f"--shard={text}"])

        assert stopped.value.code == 1
        assert "argument --shard: expected a number" in capsys.readouterr().err.replace(
            "expected the number", "expected a number"
        )

    def test_shards_go_to_folders_of_their_own_and_the_whole_is_resumed_as_one_run(
        self, bench: Bench, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = bench.folder / "runs/x"
        command = ["eval", "--task", TASK, "--policy", "random", "--episodes", "4", "--workers", "1"]
        command += ["--set", "simulator=fake", "--set", "env.horizon_steps=12", "--out", str(out)]
        for number in (1, 2):
            assert main([*command, "--shard", f"{number}/2"]) == 0
        shards = [str(bench.folder / f"runs/x-shard-{number}-of-2") for number in (1, 2)]
        capsys.readouterr()

        assert main(["merge", *shards, "--out", str(out)]) == 0
        assert capsys.readouterr().out == f"{out}: 4 episodes of 2 shards\n"
        assert main(command) == 0
        assert "all 4 episodes are there" in capsys.readouterr().err

    def test_a_probe_is_merged_world_by_world_and_then_printed(
        self, bench: Bench, capsys: pytest.CaptureFixture[str]
    ) -> None:
        command = [
            *("probe", "--task", TASK, "--policy", "hold", "--no-controls", "--probe", "blank"),
            *("--episodes", "2", "--workers", "1", "--set", "simulator=fake"),
            *("--out", str(bench.folder / "probe")),
        ]
        for number in (1, 2):
            assert main([*command, "--shard", f"{number}/2"]) == 0
            assert capsys.readouterr().out == f"{bench.folder}/probe-shard-{number}-of-2\n"

        shards = [str(bench.folder / f"probe-shard-{number}-of-2") for number in (1, 2)]
        assert main(["merge", *shards, "--out", str(bench.folder / "probe")]) == 0
        worlds = [f"{bench.folder}/probe/{TASK}_{name}: 2 episodes of 2 shards" for name in ("blank", "none")]
        assert sorted(capsys.readouterr().out.splitlines()) == worlds
        assert main(command) == 0
        assert "all 2 episodes are there" in capsys.readouterr().err

    @pytest.mark.slow
    def test_an_audit_is_merged_evaluation_by_evaluation_and_then_printed(
        self, bench: Bench, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def command(name: str) -> list[str]:
            return [
                *("audit", "--task", "InterceptMedium-v0", "--episodes", "2", "--workers", "1"),
                *("--set", "simulator=fake", "--out", str(bench.folder / name)),
            ]

        assert main(command("one")) == 0
        whole = capsys.readouterr().out
        for number in (1, 2):
            assert main([*command("audit"), "--shard", f"{number}/2"]) == 0
        capsys.readouterr()

        shards = [str(bench.folder / f"audit-shard-{number}-of-2") for number in (1, 2)]
        assert main(["merge", *shards, "--out", str(bench.folder / "audit")]) == 0
        # 5 controls × 2 seeds
        assert capsys.readouterr().out.endswith("audit_paper_ball: 10 episodes of 2 shards\n")
        assert main(command("audit")) == 0
        assert capsys.readouterr().out == whole
