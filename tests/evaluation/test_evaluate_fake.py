"""Whole runs on the fake simulator: the same lines however they are run, resumed as what they were."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import TASK, Bench
from tests.evaluation.resolved import default_run_folder, evaluate
from vla_eval.cli.main import main
from vla_eval.errors import RecipeError, RunChangedError
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.records import EpisodeRecord
from vla_eval.results.report import build_table
from vla_eval.storage.run_folder import read_run
from vla_eval.workers.load import Load
from vla_eval.workers.local import LocalBackend

pytestmark = pytest.mark.usefixtures("light_workers")

bench = evaluation_bench.bench


# ------------------------------------------------------------------------------------------ side by side


class TestSlots:
    def test_records_do_not_depend_on_how_many_episodes_run_side_by_side(self, bench: Bench) -> None:
        bench.write_policy("pair_policy:make")

        bench.run("alone", runs=2)
        bench.run("beside", runs=2, slots_per_worker=4)

        assert len(bench.lines("alone")) == 12
        assert bench.lines("beside") == bench.lines("alone")
        # 12 control steps each: 12 episodes one by one; then, per run, 4 side by side and 2 side by side.
        passes = (bench.folder / "passes").read_text().split()
        assert passes == ["1"] * 12 * 12 + (["4"] * 12 + ["2"] * 12) * 2

    def test_a_policy_is_given_the_row_that_an_episodes_seed_has(self, bench: Bench) -> None:
        bench.write_policy("pair_policy:make")

        bench.run("out", slots_per_worker=4)

        # Seeds 1 … 6 in four rows, four episodes side by side and then two.
        rows = (bench.folder / "rows").read_text().splitlines()
        assert rows == ["1:0 2:1 3:2 4:3", "5:0 6:1"]

    def test_an_error_is_the_error_of_one_episode_and_not_of_its_neighbours(self, bench: Bench) -> None:
        bench.write_policy("pair_policy:make")
        bench.run("alone")
        bench.write_policy("pair_policy:make", fails_at=3)

        summary = bench.run("beside", slots_per_worker=4)

        records = bench.records("beside")
        assert (summary.n_errors, summary.n_open) == (1, 1)
        assert {seed for seed, record in records.items() if record.error is not None} == {3}
        bench.mend()
        assert bench.run("beside", slots_per_worker=4).n_open == 0
        assert bench.lines("beside") == bench.lines("alone")

    def test_a_run_is_not_continued_with_another_number_of_slots(self, bench: Bench) -> None:
        bench.run("out")
        with pytest.raises(RunChangedError, match="slots_per_worker"):
            bench.run("out", slots_per_worker=2)


# ------------------------------------------------------------------------------------------ start


def test_only_a_new_run_that_can_be_run_prepares_workers(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared: list[tuple[str, ...]] = []
    monkeypatch.setattr(LocalBackend, "prepare", lambda _, preload: prepared.append(preload))
    with pytest.raises(RecipeError, match="prompt_set"):
        bench.run("refused", env={"instruction": "go"})
    assert prepared == []

    bench.run("out", policies=["random"])
    assert prepared == [("vla_eval.evaluation.worker", "vla_eval.policies.controls.scripted")]

    bench.run("out", policies=["random"])
    assert len(prepared) == 1


# ------------------------------------------------------------------------------------------ sameness


class TestSameness:
    def test_any_number_of_workers_gives_the_same_lines(self, bench: Bench) -> None:
        fields: dict[str, Any] = {
            "tasks": [TASK, "InterceptMedium-v0"],
            "policies": [str(bench.folder / "night.yaml"), "random"],
            "n_action_steps": [1, 3],
            "runs": 2,
            "env": {"horizon_steps": 12},
        }
        bench.run("one", workers=1, **fields)
        bench.run("two", workers=2, **fields)

        # 2 tasks x 2 policies x 2 K x 2 runs x 6 seeds
        assert len(bench.lines("one")) == 96
        assert bench.lines("one") == bench.lines("two")

    def test_pictures_change_nothing_but_the_device_is_noted(self, bench: Bench) -> None:
        bench.run("blind")
        bench.write_policy(cameras=["base_camera"])
        bench.run("seeing")

        assert bench.lines("blind") == bench.lines("seeing")
        assert read_run(bench.folder / "seeing").description.environment["device"] == {"simulator": "fake"}

    def test_runs_differ_for_a_policy_that_draws_by_run(self, bench: Bench) -> None:
        bench.run("out", runs=2, episodes=1)

        digests = {record.trajectory_sha256 for record in read_run(bench.folder / "out").records}
        assert len(digests) == 2

    def test_the_record_s_policy_is_the_recipe_s_name(self, bench: Bench) -> None:
        bench.run("out", episodes=1)

        assert bench.records("out")[1].policy == "night"

    def test_scripted_controls_do_on_the_fake_what_they_are_for(self, bench: Bench) -> None:
        bench.run("out", policies=["oracle", "random"], episodes=5, env={})

        rates = {
            policy: [r.success_once for r in read_run(bench.folder / "out").records if r.policy == policy]
            for policy in ("oracle", "random")
        }
        assert rates["oracle"] == [True] * 5
        assert rates["random"] == [False] * 5


# ------------------------------------------------------------------------------------------ resume


def test_an_observer_is_given_the_steps_of_an_episode_while_it_runs(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate_module, "LOAD_SECONDS", 0.0)
    bench.write_policy(pause=0.25)  # four inferences: a second, and five ticks of the pool
    loads: list[Load] = []

    class Observer(evaluate_module.EvaluationObserver):
        def on_load(self, load: Load) -> None:
            loads.append(load)

    evaluate(bench.config(episodes=1, n_action_steps=[3]), out=bench.folder / "out", observer=Observer())

    counted = [load.n_counted for load in loads if load.n_running]
    # Of its 12 steps, as many as there were by then.
    assert 0 < max(counted) <= 12 and counted == sorted(counted)


def test_when_a_record_comes_its_steps_are_no_longer_among_those_under_way(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The last time before the episode's end is well before it.
    monkeypatch.setattr(evaluate_module, "LOAD_SECONDS", 0.4)
    bench.write_policy(pause=0.25)
    under_way: list[int | None] = []
    when_recorded: list[int | None] = []

    class Observer(evaluate_module.EvaluationObserver):
        def on_load(self, load: Load) -> None:
            under_way.append(load.n_counted)

        def on_record(self, record: EpisodeRecord) -> None:
            when_recorded.append(under_way[-1])

    evaluate(bench.config(episodes=1, n_action_steps=[3]), out=bench.folder / "out", observer=Observer())

    assert max(n or 0 for n in under_way) > 0 and when_recorded == [0]


class TestResume:
    def test_a_finished_run_is_not_run_again(self, bench: Bench) -> None:
        bench.run("out")
        before = bench.worker_pids()

        summary = bench.run("out")

        assert summary.n_open == 0
        assert bench.worker_pids() == before

    def test_a_changed_configuration_is_refused(self, bench: Bench) -> None:
        bench.run("out")

        with pytest.raises(RunChangedError, match="episodes"):
            bench.run("out", episodes=5)

    def test_a_run_that_grew_has_the_records_of_one_made_at_once(self, bench: Bench) -> None:
        first: dict[str, Any] = {"episodes": 5, "slots_per_worker": 2}
        bench.run("grown", **first)
        begun = (bench.folder / "grown/episodes.jsonl").read_bytes()
        whole: dict[str, Any] = {
            **first,
            "episodes": 6,
            "runs": 2,
            "policies": ["random", str(bench.folder / "night.yaml")],
        }

        summary = bench.run("grown", **whole)
        bench.run("at once", **whole)

        # 2 policies x 2 runs x 6 seeds
        assert (summary.n_episodes, summary.n_open) == (24, 0)
        assert bench.lines("grown") == bench.lines("at once")
        assert (bench.folder / "grown/episodes.jsonl").read_bytes().startswith(begun)
        grown, at_once = (read_run(bench.folder / name).description for name in ("grown", "at once"))
        assert (grown.config, grown.recipes) == (at_once.config, at_once.recipes)

    def test_a_changed_recipe_is_refused(self, bench: Bench) -> None:
        bench.run("out")
        bench.write_policy(pause=0.001)

        with pytest.raises(RunChangedError, match="policies/night"):
            bench.run("out")

    def test_options_may_change(self, bench: Bench) -> None:
        bench.run("out")

        assert bench.run("out", workers=2, timeouts={"step_seconds": 9.0}).n_open == 0

    def test_the_default_folder_is_that_of_the_configuration(self, bench: Bench) -> None:
        first, same = default_run_folder(bench.config()), default_run_folder(bench.config(workers=2))
        other = default_run_folder(bench.config(episodes=7))

        assert first == same != other
        assert first.parent == Path("runs")
        assert first.name.startswith("test-")


# ------------------------------------------------------------------------------------------ run seeds


class TestRunSeeds:
    def test_each_of_several_checkpoints_is_one_run_of_the_same_policy(self, bench: Bench) -> None:
        first = bench.write_policy(name="a", faults={"2": "raise"})
        second = bench.write_policy(name="b", faults={"3": "raise"})

        summary = bench.run("out", policies=["random", f"mine={first},{second}"], episodes=4, workers=2)

        stored = read_run(bench.folder / "out")
        assert (summary.n_episodes, summary.n_errors) == (4 + 2 * 4, 2)
        assert {(r.policy, r.run, r.seed) for r in stored.records if r.outcome == "error"} == {
            ("mine", 0, 2),
            ("mine", 1, 3),
        }
        assert {"policies/mine/run-0", "policies/mine/run-1"} < set(stored.description.recipes)

    def test_a_checkpoint_more_is_a_run_more_of_the_same_folder(self, bench: Bench) -> None:
        paths = [str(bench.write_policy(name=name, pause=i / 1e6)) for i, name in enumerate("abc")]
        bench.run("grown", policies=[f"mine={','.join(paths[:2])}"], episodes=2)
        begun = (bench.folder / "grown/episodes.jsonl").read_bytes()

        bench.run("grown", policies=[f"mine={','.join(paths)}"], episodes=2)
        bench.run("at once", policies=[f"mine={','.join(paths)}"], episodes=2)

        assert bench.lines("grown") == bench.lines("at once")
        assert (bench.folder / "grown/episodes.jsonl").read_bytes().startswith(begun)
        with pytest.raises(RunChangedError, match=r"config\.policies"):
            bench.run("grown", policies=[f"mine={','.join(reversed(paths))}"], episodes=2)


class TestOneCheckpointPerTask:
    @pytest.mark.slow
    def test_a_run_grows_by_a_task_with_its_checkpoint_and_refuses_another_one(self, bench: Bench) -> None:
        color, shell = "RememberColor3-v0", "ShellGameTouch-v0"
        first, second, third = (bench.write_policy(name=name, pause=i / 1e6) for i, name in enumerate("abc"))
        own = f"mine:{color}={first}"
        bench.run("grown", tasks=[color], policies=[own, "oracle"], episodes=2)
        begun = (bench.folder / "grown/episodes.jsonl").read_bytes()

        both = {"tasks": [color, shell], "policies": [own, "oracle", f"mine:{shell}={second},{third}"]}
        bench.run("grown", **both, episodes=2)
        bench.run("at once", **both, episodes=2)

        assert bench.lines("grown") == bench.lines("at once")
        assert (bench.folder / "grown/episodes.jsonl").read_bytes().startswith(begun)
        rows = Counter((r.task, r.policy, r.run) for r in read_run(bench.folder / "grown").records)
        assert rows[shell, "mine", 1] == rows[shell, "mine", 0] == rows[color, "mine", 0] == 2
        assert (
            "mine: another checkpoint for each task." in build_table([read_run(bench.folder / "grown")]).notes
        )
        second.write_text(second.read_text() + "\n")
        with pytest.raises(RunChangedError, match=rf"recipes\.policies/mine/{shell}/run-0"):
            bench.run("grown", **both, episodes=2)


# ------------------------------------------------------------------------------------------ command line


class TestCommandLine:
    def test_standard_output_carries_the_table_alone(
        self, bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(bench.folder)

        code = main(["eval", "demo", "--episodes", "2", "--set", "simulator=fake", "--format", "json"])

        out, err = capsys.readouterr()
        assert code == 0
        # 2 tasks x 3 policies
        assert len(json.loads(out)["rows"]) == 6
        assert "12 episodes, 0 of them finished before" in err

    def test_a_second_run_prints_the_same_table_and_runs_nothing(
        self, bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(bench.folder)
        command = [
            "eval",
            "--task",
            TASK,
            "--policy",
            "night.yaml",
            "--episodes",
            "3",
            "--set",
            "simulator=fake",
        ]
        assert main(command) == 0
        first = capsys.readouterr()

        assert main(command) == 0

        second = capsys.readouterr()
        assert second.out == first.out
        assert "all 3 episodes are there" in second.err
        assert len(list((bench.folder / "runs").iterdir())) == 1

    def test_episodes_that_ended_in_an_error_have_an_exit_code_of_their_own(
        self, bench: Bench, capsys: pytest.CaptureFixture[str]
    ) -> None:
        bench.write_policy(faults={"2": "raise"})
        command = ["eval", "--task", TASK, "--policy", str(bench.folder / "night.yaml"), "--episodes", "3"]
        command += ["--out", str(bench.folder / "out"), "--set", "simulator=fake"]

        code = main(command)

        err = capsys.readouterr().err
        assert code == 3
        assert f"error: night on {TASK}, seed 2, run 0: ZeroDivisionError: a mistake in the policy" in err
        assert "1 episodes ended in an error" in err
