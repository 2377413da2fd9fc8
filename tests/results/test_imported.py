"""Results of other programs: counted again, refused where they contradict themselves, never mixed in."""

import csv
import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.results.stored_runs import episodes, stored
from vla_eval.cli.main import main
from vla_eval.errors import ReportError
from vla_eval.results.estimates import wilson_interval
from vla_eval.results.imported.programs import PROGRAMS
from vla_eval.results.imported.reading import read_imported
from vla_eval.results.imported.rows import ImportedRow
from vla_eval.results.report import build_table, render

DOCS = Path(__file__).parents[2] / "docs"


def lerobot() -> dict[str, Any]:
    """As lerobot 0.6.1 writes it, with a task of 4 episodes and one of 2."""
    tasks = [("mikasa", 0, [True, False, True, True]), ("mikasa", 1, [False, False])]
    return {
        "per_task": [
            {
                "task_group": group,
                "task_id": number,
                "metrics": {
                    "sum_rewards": [0.0] * len(won),
                    "successes": won,
                },
            }
            for group, number, won in tasks
        ],
        "per_group": {},
        "overall": {"pc_success": 50.0, "n_episodes": 6, "eval_s": 1.5, "avg_sum_reward": 0.0},
    }


def allenai() -> dict[str, Any]:
    """As vla-evaluation-harness 0.8.0 writes it: an error is an episode without success."""
    won = [{"episode_id": i, "metrics": {"success": i != 1}, "steps": 60} for i in range(3)]
    lost = {"episode_id": 3, "metrics": {"success": False}, "failure_reason": "reconnect"}
    task = {"task": "RememberColor3-v0", "episodes": [*won, lost], "num_episodes": 4, "mean_success": 0.5}
    return {"benchmark": "mikasa", "mode": "sync", "harness_version": "0.8.0", "tasks": [task], "config": {}}


def official() -> dict[str, Any]:
    """As mikasa-robo-suite 1.0.0 writes the file of a task: the fields of one that its runner wrote."""
    return {
        "env_id": "RememberColor3-VLA-v0",
        "split": "Short",
        "memory_type": "object",
        "start_seed": 4242424242,
        "n_episodes": 4,
        "successes": [True, True, True, False],
        "returns": [1.0842565782368183, 0.11475700698792934, 0.5033348128199577, 0.0],
        "sr": 0.75,
        "mean_return": 0.4255870983487739,
        "benchmark_commit": None,
        "control_mode": "pd_ee_delta_pose",
        "obs_mode": "rgb",
        "wrapper_chain": "apply_mikasa_vla_wrappers(include_overlays=False)",
        "action_chunk_size": 1,
        "model": {"name": "mine", "steps": 5},
        "episode_lengths": [25, 25, 25, 25],
        "episode_seeds": [4242424242, 4242424243, 4242424244, 4242424245],
    }


def inspect_robots() -> dict[str, Any]:
    """As inspect-robots 0.60.0 writes a log: a trial that ended in an error has no score."""
    spec = {"task": "reach", "policy": "random", "embodiment": "cubepick", "inspect_robots_version": "0.60.0"}
    samples = [
        {"scene_id": "a", "epochs": [{"success_at_end": 1.0}, {}], "status": "error"},
        {"scene_id": "b", "epochs": [{"success_at_end": 0.0}, {"success_at_end": 1.0}], "status": "success"},
    ]
    return {"version": 1, "status": "success", "eval": {**spec, "max_steps": 80}, "samples": samples}


def inspect_ai() -> dict[str, Any]:
    """The fields of a log that inspect_ai 0.3.285 wrote: five samples, two epochs, one sample that raised."""
    spec = {"task": "remember_color", "model": "mockllm/model", "config": {"epochs": 2}, "dataset": {}}
    samples: list[dict[str, Any]] = []
    for epoch, number in itertools.product((1, 2), range(1, 6)):
        score = {"success": {"value": "C" if number % 2 else "I", "history": []}}
        samples.append({"id": number, "epoch": epoch, "scores": score, "target": "x"})
    samples[3] |= {"scores": {}, "error": {"message": "simulator died", "traceback": "…"}}
    return {
        "version": 2,
        "status": "success",
        "eval": spec,
        "plan": {"name": "plan", "steps": [{"solver": "act"}]},
        "results": {"total_samples": 10, "completed_samples": 9, "scores": [{"name": "success"}]},
        "stats": {},
        "samples": samples,
    }


def robostats() -> str:
    """As `EpisodeRecorder` of robostats 0.2.0 writes it."""
    common = {"schema_version": 2, "policy_id": "p", "task_id": "RememberColor3-v0", "scenario_id": "s"}
    protocol = {"execution_horizon": 8, "max_steps": 60}
    lines = ({**common, "success": seed != 2, "seed": seed, "protocol": protocol} for seed in (1, 2, 3))
    return "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)


def openvla_oft() -> str:
    """As openvla-oft's script at 213c5ff logs it: two tasks, one error, which it counts as a failure."""
    return "\n".join(
        [
            *("Task suite: libero_10", "", "Task: put the bowl away", "Starting episode 1..."),
            *("Success: True", "# episodes completed so far: 1", "# successes: 1 (100.0%)"),
            *("Starting episode 2...", "Episode error: out of memory", "Success: False"),
            *("# episodes completed so far: 2", "# successes: 1 (50.0%)"),
            *("Current task success rate: 0.5", "Task: open the drawer", "Success: False"),
            *("# episodes completed so far: 3", "# successes: 1 (33.3%)"),
        ]
    )


FILES: dict[str, Callable[[], dict[str, Any] | str]] = {
    "lerobot-eval": lerobot,
    "allenai's vla-evaluation-harness": allenai,
    "official MIKASA-Robo-VLA runner": official,
    "inspect-robots": inspect_robots,
    "inspect_ai": inspect_ai,
    "robostats": robostats,
    "openvla-oft": openvla_oft,
}


def written(folder: Path, content: dict[str, Any] | str, name: str = "results") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def read(folder: Path, content: dict[str, Any] | str) -> list[ImportedRow]:
    return list(read_imported(written(folder, content)))


# program -> (task, policy, successes, episodes with a result, errors) of each row
COUNTS: dict[str, list[tuple[str, str | None, int, int, int]]] = {
    "lerobot-eval": [("mikasa/0", None, 3, 4, 0), ("mikasa/1", None, 0, 2, 0)],
    "allenai's vla-evaluation-harness": [("RememberColor3-v0", None, 2, 3, 1)],
    "official MIKASA-Robo-VLA runner": [("RememberColor3-VLA-v0", "mine", 3, 4, 0)],
    "inspect-robots": [("reach", "random", 2, 3, 1)],
    "inspect_ai": [("remember_color", "mockllm/model", 6, 9, 1)],
    "robostats": [("RememberColor3-v0", "p", 2, 3, 0)],
    "openvla-oft": [
        ("libero_10: put the bowl away", None, 1, 1, 1),
        ("libero_10: open the drawer", None, 0, 1, 0),
    ],
}


@pytest.mark.parametrize("program", [one.name for one in PROGRAMS])
def test_each_program_is_counted_again_with_errors_apart(program: str, tmp_path: Path) -> None:
    rows = read(tmp_path, FILES[program]())
    found = [(one.task, one.policy, one.n_success, one.n_episodes, one.n_errors) for one in rows]
    assert found == COUNTS[program]
    assert all(one.interval == wilson_interval(one.n_success, one.n_episodes) for one in rows)
    assert program in (DOCS / "imported.md").read_text(encoding="utf-8")


def test_what_a_file_states_is_in_the_passport_and_the_rest_is_unknown(tmp_path: Path) -> None:
    (row,) = read(tmp_path, official())
    passport = row.passport
    assert passport.values["control_mode"] == ("pd_ee_delta_pose",)
    assert passport.values["seeds"] == ("4242424242 to 4242424245",)
    assert passport.values["success_rule"] == ("success at any step",)
    # The chunk size that a policy states need not be what it executes.
    assert passport.values["n_action_steps"] == (None,) and "perhaps 1" in passport.text("n_action_steps")
    (row,) = read(tmp_path, robostats())
    assert row.passport.values["n_action_steps"] == ("8",)
    assert row.passport.values["horizon"] == ("60 control steps",)
    assert row.passport.values["success_rule"] == (None,)
    (row,) = read(tmp_path, inspect_robots())
    assert row.passport.values["success_rule"] == ("success at the last step",)


def change(content: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    """Return the content with one value replaced."""
    *above, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place: Any = content
    for part in above:
        place = place[part]
    place[last] = value
    return content


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (change(lerobot(), "overall.pc_success", 66.7), "its episodes are 3 of 6"),
        (change(lerobot(), "overall.n_episodes", 7), "it has 6 episodes"),
        (change(lerobot(), "per_task.0.metrics.successes", [1, 0, 1, 1]), "true or false"),
        (change(lerobot(), "per_task.0.metrics", {}), "successes"),
        (change(lerobot(), "per_task", []), "no episode has a result"),
        (change(allenai(), "tasks.0.mean_success", 0.6667), "its episodes are 2 of 4"),
        (change(allenai(), "tasks.0.episodes.0.metrics", {"success": 0.5}), "expected true or false"),
        (change(allenai(), "tasks.0.episodes.0.metrics", {}), "expected true or false"),
        (change(official(), "sr", 0.5), "its episodes are 3 of 4"),
        (change(official(), "n_episodes", 5), "n_episodes is 5"),
        (change(official(), "control_mode", None), "control_mode"),
        (change(inspect_robots(), "version", 2), "expected version 1"),
        (change(inspect_robots(), "samples.1.epochs.0", {"success_at_end": 0.5}), "expected 0 or 1"),
        (change(inspect_robots(), "samples.1.epochs.0", {"reached": 1.0}), "expected 0 or 1"),
        (change(inspect_ai(), "version", 1), "expected version 2"),
        (change(inspect_ai(), "results.completed_samples", 10), "9 have a score"),
        (change(inspect_ai(), "samples.0.scores.success.value", "P"), "expected C or I"),
        (change(inspect_ai(), "samples.0.scores.success.value", 0.5), "expected C or I"),
        (change(inspect_ai(), "samples.0.scores.success.value", None), "expected C or I"),
        (change(inspect_ai(), "samples.0.scores", {"a": {"value": "C"}, "b": {"value": "I"}}), "score None"),
        (robostats().replace("false", "0"), "line 2"),
        (robostats().replace('"task_id"', '"task"'), "task_id"),
        (openvla_oft().replace("# successes: 1 (33.3%)", "# successes: 2 (66.7%)"), "the episodes above it"),
        (openvla_oft().replace("Task: put the bowl away\n", ""), "below a task"),
        (change(allenai(), "tasks", []), "no task with an episode"),
        ("# episodes completed so far: 0", "no task with an episode"),
        ({"per_task": []}, "no known program"),
        ("nothing of the kind", "neither JSON nor a log"),
    ],
)
def test_what_contradicts_itself_or_is_something_else_is_refused(
    content: dict[str, Any] | str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ReportError, match="results") as error:
        read(tmp_path, content)
    assert said in str(error.value)


def test_of_several_scorers_the_one_that_is_called_success_counts(tmp_path: Path) -> None:
    log = inspect_ai()
    for sample in log["samples"]:
        sample["scores"] |= {"length": {"value": 60}} if sample["scores"] else {}
    (row,) = read(tmp_path, log)
    assert (row.n_success, row.n_episodes) == (6, 9)
    for sample in log["samples"]:
        sample["scores"] = {f"my_{name}": score for name, score in sample["scores"].items()}
    with pytest.raises(ReportError, match=r"scores of my_length, my_success.*'success'"):
        read(tmp_path, log)


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="there is no such file"):
        read_imported(tmp_path / "nothing")
    with pytest.raises(ReportError, match="a folder"):
        read_imported(tmp_path)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe")
    with pytest.raises(ReportError, match="not UTF-8"):
        read_imported(tmp_path / "bytes")


def test_they_stand_in_a_table_of_their_own_and_are_marked_in_csv_and_json(tmp_path: Path) -> None:
    rows = [*read(tmp_path, allenai()), *read(tmp_path, official())]
    table = build_table([stored(episodes("p", "++--"))])
    measured, imported = render(table, "markdown", imported=rows).split("Imported results, counted by other")
    assert "official runner" in imported and "official runner" not in measured
    assert "its own figure counts errors as failures (1)" in imported
    lines = list(csv.DictReader(io.StringIO(render(table, "csv", imported=rows))))
    marked = [line for line in lines if line["source"].startswith("imported: ")]
    assert len(lines) == 3 and len(marked) == 2
    # Whether a program's success is success once is its own affair.
    assert [line["success_once"] for line in marked] == ["", ""]
    assert [float(line["success"]) for line in marked] == pytest.approx([2 / 3, 0.75])
    data = json.loads(render(table, "json", imported=rows))
    assert len(data["rows"]) == 1 and len(data["imported"]) == 2


def test_the_verbs_take_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(written(tmp_path, lerobot(), "eval_info.json"))
    assert main(["report", "--imported", path]) == 0
    assert "lerobot-eval" in capsys.readouterr().out
    assert main(["passport", path, "GMP"]) == 0
    assert "success at any step" in capsys.readouterr().out
    assert main(["report", "--imported", str(tmp_path / "nothing.json")]) == 1
    assert "there is no such file" in capsys.readouterr().err
