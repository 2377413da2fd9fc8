"""What is read from a run folder is checked: what cannot be true is one message; the file stays as it is."""

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.storage.run_records import describe
from vla_eval.cli.main import main
from vla_eval.errors import RunFolderError
from vla_eval.records import EpisodeKey, EpisodeRecord, EpisodeTiming
from vla_eval.storage.run_folder import RunDescription, RunFolder, read_run
from vla_eval.storage.timings import read_timings

RECORD = EpisodeRecord(
    task="A",
    policy="oracle",
    n_action_steps=2,
    run=0,
    seed=3,
    outcome="success",
    success_once=True,
    success_at_end=False,
    success_step=20,
    n_steps=60,
    target=2,
    n_candidates=3,
    first_choice=2,
    first_choice_success=True,
    n_wrong_choices=1,
    chance_success=1 / 3,
    episode_return=-1.5,
    n_inferences=30,
    n_frames=60,
    n_clipped_steps=0,
    trajectory_sha256="ab",
    target_place=1,
    first_choice_place=1,
    tcp_reach_m=0.25,
    right_candidates=(2,),
    touched_candidates=(2, 0),
    candidate_places=(0, 2, 1),
    candidate_names=("ball", "a cup", "ell"),
)
ADDED_ALONE = frozenset(
    {
        *("tcp_reach_m", "chance_success", "right_candidates", "touched_candidates", "candidate_places"),
        *("final_turn_rad", "n_held_steps", "mean_age_steps", "delay_steps", "motion", "candidate_names"),
    }
)
"""Fields that records of earlier versions lack, each independent of the others."""
VALID: dict[str, Any] = json.loads(RECORD.to_json())
ERROR = {"kind": "WorkerCrashed", "stage": "step", "message": "gone", "details": None}
NO_RESULT = {name: None for name in list(VALID)[list(VALID).index("success_once") :]}
CONFIG = {
    "tasks": ["A"],
    "task_versions": {"A": 1},
    "policies": ["oracle"],
    "policy_names": ["oracle"],
    "n_action_steps": [2],
    "seed_start": 1,
    "episodes": 5,
    "runs": 2,
}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a touch twice": ({"touched_candidates": [2, 0, 2]}, "touched_candidates different from each other"),
    "a touch of none": ({"touched_candidates": [2, 3]}, "each < n_candidates"),
    "another first touch": ({"touched_candidates": [0, 2]}, "the first choice first among those touched"),
    "another right one": ({"right_candidates": [1]}, "the target as the only right candidate"),
    "a place twice": ({"candidate_places": [0, 1, 1]}, "a place of its own for each candidate"),
    "an unknown outcome": ({"outcome": "banana"}, "'success', 'failure', 'finished' or 'error'"),
    "a failure that succeeded": (
        {"outcome": "failure"},
        "success_once true for the outcome 'success', false for 'failure' and null for 'finished'",
    ),
    "lost without a rule": (
        {"outcome": "finished", "success_once": False, "success_at_end": None, "success_step": None},
        "success_once true for the outcome 'success', false for 'failure' and null for 'finished'",
    ),
    "a success that did not": ({"success_once": False}, "success_once true"),
    "a success of which that is unknown": ({"success_once": None}, "success_once true"),
    "a chance of 7": ({"chance_success": 7}, "chance_success 7"),
    "a negative chance": ({"chance_success": -0.1}, "chance_success -0.1"),
    "a list for a seed": ({"seed": [6]}, r"seed \[6\] \(expected a whole number"),
    "true for a seed": ({"seed": True}, r"seed True \(expected a whole number"),
    "text for a seed": ({"seed": "3"}, "expected a whole number"),
    "a fraction for a seed": ({"seed": 3.0}, "expected a whole number"),
    "a negative seed": ({"seed": -1}, "greater than or equal to 0"),
    "a seed beyond 64 bits": ({"seed": 2**63}, "less than or equal to"),
    "no task": ({"task": None}, "task None .expected text"),
    "a task without letters": ({"task": ""}, "a name of 1 to 255"),
    "a task of two lines": ({"task": "A\nB"}, "printable characters"),
    "a task with two namespaces": ({"task": "a/b/C-v0"}, "or a namespace, '/' and a name"),
    "a task without a name": ({"task": "mikasa_vla/"}, "or a namespace, '/' and a name"),
    "a policy that is a path": ({"policy": "../oracle"}, "without '/'"),
    "text in n_steps": ({"n_steps": "60"}, "n_steps '60' .expected a whole number"),
    "K of 0": ({"n_action_steps": 0}, "greater than or equal to 1"),
    "a success after the end": ({"success_step": 61}, "success_step ≤ n_steps"),
    "a success step of a failure": (
        {"outcome": "failure", "success_once": False},
        "success_step null where success_once is false",
    ),
    "more inferences than steps": ({"n_inferences": 61}, "n_inferences ≤ n_steps"),
    "a negative count": ({"n_clipped_steps": -1}, "n_clipped_steps -1"),
    "a choice beyond the candidates": ({"first_choice": 3}, "first_choice < n_candidates"),
    "a target beyond the candidates": ({"target": 3}, "target < n_candidates"),
    "a right choice that is not the target": ({"first_choice": 1}, "where the first choice is the target"),
    "a target without candidates": ({"n_candidates": None}, "where n_candidates is null"),
    "an error without a cause": ({**NO_RESULT, "outcome": "error"}, "an error with the outcome 'error'"),
    "a cause without an error": ({"error": ERROR}, "an error with the outcome 'error'"),
    "an error with a result": ({**NO_RESULT, "outcome": "error", "error": ERROR, "n_steps": 5}, "no result"),
    "a cause of another form": ({**NO_RESULT, "outcome": "error", "error": {"kind": 5}}, "error"),
    "an unknown field": ({"colour": "red"}, "the field 'colour' .there is no such field"),
    "another version": ({"record_version": 3}, "record version 3, this program reads version 1 and 2"),
    "true for a version": ({"record_version": True}, "record_version True"),
}


def make(folder: Path, *lines: str, **changes: Any) -> Path:
    """Make a run folder with these lines."""
    with RunFolder.open(folder, description(**changes)):
        pass
    (folder / "episodes.jsonl").write_text("".join(f"{line}\n" for line in lines))
    return folder


def description(**changes: Any) -> RunDescription:
    return describe(config={**CONFIG, **changes})


def changed(**changes: Any) -> str:
    return json.dumps({**VALID, **changes})


def without(*names: str) -> str:
    return json.dumps({name: value for name, value in VALID.items() if name not in names})


def refused(folder: Path, message: str) -> None:
    """Assert that report and resume say this, and that the files are as they were."""
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.name != "run.lock"]
    before = {path: path.read_bytes() for path in files}
    with pytest.raises(RunFolderError, match=message):
        read_run(folder)
    with pytest.raises(RunFolderError, match=message):
        RunFolder.open(folder, description())
    assert {path: path.read_bytes() for path in files} == before


# ------------------------------------------------------------------------------------------ records


def test_a_sound_record_is_read_back(tmp_path: Path) -> None:
    assert read_run(make(tmp_path / "r", changed())).records == (RECORD,)


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_record_that_cannot_be_true_is_refused_with_its_line(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    folder = make(tmp_path / "r", changed(seed=1), changed(**changes))
    refused(folder, rf"episodes\.jsonl:2: .*{message}")


@pytest.mark.parametrize("name", [n for n in VALID if n not in ("target_place", "first_choice_place")])
def test_a_missing_field_is_named_unless_older_records_lack_it(tmp_path: Path, name: str) -> None:
    folder = make(tmp_path / "r", without(name))
    if name in ADDED_ALONE:
        assert getattr(read_run(folder).records[0], name) is None
    else:
        refused(folder, rf"episodes\.jsonl:1: .*no field '{name}'")


def test_records_of_earlier_versions_are_read(tmp_path: Path) -> None:
    older = without("target_place", "first_choice_place", "tcp_reach_m", "chance_success")
    (record,) = read_run(make(tmp_path / "r", older)).records
    assert (record.target, record.target_place, record.first_choice_place) == (2, None, None)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_a_number_that_is_not_finite_is_refused(tmp_path: Path, number: str) -> None:
    line = changed().replace('"episode_return": -1.5', f'"episode_return": {number}')
    refused(make(tmp_path / "r", line), rf"episodes\.jsonl:1: .*{number}")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (changed()[:-1] + ', "seed": 4}', "the field 'seed' twice"),
        (changed()[:-1] + ', "x": ' + "[" * 100_000 + "]" * 100_000 + "}", "nesting of more than 50 levels"),
        ("[" * 100_000, "nesting of more than 50 levels"),
        (changed().replace('"seed": 3', '"seed": ' + "9" * 5000), "4300"),
        (changed().replace('"seed": 3', '"seed": ' + "9" * 4000), "seed a very large number"),
        ("[1]", "expected a mapping"),
        ("5", "expected a mapping"),
        ("", "Expecting value"),
    ],
    ids=["a field twice", "deep", "deep and open", "5,000 digits", "4,000 digits", "list", "number", "empty"],
)
def test_json_that_is_no_record_is_refused(tmp_path: Path, line: str, message: str) -> None:
    refused(make(tmp_path / "r", line, changed()), rf"episodes\.jsonl:1: expected an episode .*{message}")


def test_the_message_of_a_long_line_is_short(tmp_path: Path) -> None:
    folder = make(tmp_path / "r", changed(outcome="x\n" * 100_000))
    with pytest.raises(RunFolderError) as caught:
        read_run(folder)
    assert len(str(caught.value)) < 1000 and "\n" not in str(caught.value)


def test_a_record_that_could_not_be_read_back_is_not_stored(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", description()) as folder:
        wrong = EpisodeRecord(
            task="A", policy="oracle", n_action_steps=2, run=0, seed=1, outcome="failure", success_once=True
        )
        with pytest.raises(RunFolderError, match="found outcome 'failure', success_once True"):
            folder.append(wrong)
        assert folder.finished_keys() == frozenset()
    assert read_run(tmp_path / "r").records == ()


# ------------------------------------------------------------------------------------------ the plan


def test_an_episode_that_is_not_planned_is_not_stored(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", description()) as folder:
        stranger = dataclasses.replace(RECORD, seed=6)
        with pytest.raises(RunFolderError, match=r"an episode that this run plans.*the seeds are 1 to 5"):
            folder.append(stranger)
        folder.append(RECORD)
    assert read_run(tmp_path / "r").records == (RECORD,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 0}, "seed 0.: the seeds are 1 to 5"),
        ({"seed": 6}, "the seeds are 1 to 5"),
        ({"run": 2}, "the runs are 0 to 1"),
        ({"task": "B"}, "oracle on B .*the tasks are A"),
        ({"policy": "random"}, "random on A .*the policies are oracle"),
        ({"n_action_steps": 4}, "n_action_steps are 2"),
    ],
)
def test_an_episode_that_is_not_planned_is_named_and_not_counted(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    refused(
        make(tmp_path / "r", changed(), changed(**changes)), rf"(?s)episodes\.jsonl: .*line 2: .*{message}"
    )


def test_errors_that_are_not_planned_are_named_too(tmp_path: Path) -> None:
    line = json.dumps({**VALID, **NO_RESULT, "outcome": "error", "error": ERROR, "seed": 9})
    refused(make(tmp_path / "r", line), "line 1: .*the seeds are 1 to 5")


def test_of_many_unplanned_episodes_the_first_are_named_and_all_are_counted(tmp_path: Path) -> None:
    folder = make(tmp_path / "r", *(changed(seed=seed) for seed in range(10, 30)))
    with pytest.raises(RunFolderError) as caught:
        read_run(folder)
    assert "found 20 that" in str(caught.value) and "… and 15 more" in str(caught.value)


def test_on_resume_a_policy_s_own_default_of_k_is_known(tmp_path: Path) -> None:
    folder = make(tmp_path / "r", changed(), n_action_steps=None)
    with pytest.raises(RunFolderError, match="no such policy is run on this task"):
        RunFolder.open(folder, description(n_action_steps=None), groups={("A", "oracle", 8)})


# ------------------------------------------------------------------------------------------ run.json


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("config", None),
        ("config", []),
        ("config", {**CONFIG, "tasks": 5}),
        ("config", {**CONFIG, "tasks": "A"}),
        ("config", {**CONFIG, "policy_names": [None]}),
        ("config", {**CONFIG, "episodes": "5"}),
        ("config", {**CONFIG, "runs": 0}),
        ("config", {**CONFIG, "seed_start": -1}),
        ("recipes", []),
        ("recipes", {"policies/oracle": 5}),
        ("environment", None),
        ("environment", "linux"),
        ("options", 5),
        ("name", None),
        ("command", ["eval"]),
        ("normalization", 5),
        ("sessions", None),
        ("sessions", {}),
        ("sessions", [None]),
        ("sessions", []),
        ("sessions", [{"started_at": 5}]),
        ("colour", "red"),
        ("format_version", "1"),
        ("format_version", None),
        ("format_version", 2),
    ],
)
def test_a_run_file_of_other_types_is_refused(tmp_path: Path, name: str, value: Any) -> None:
    folder = make(tmp_path / "r", changed())
    data = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**data, name: value}))
    # A configuration of other types is also another one than that which a resumed run has.
    refused(folder, r"run\.json: (expected|format version)|another configuration:\n  config")


@pytest.mark.parametrize("name", ["name", "config", "recipes", "environment", "sessions", "format_version"])
def test_a_run_file_that_lacks_a_field_is_refused(tmp_path: Path, name: str) -> None:
    folder = make(tmp_path / "r", changed())
    data = json.loads((folder / "run.json").read_text())
    del data[name]
    (folder / "run.json").write_text(json.dumps(data))
    refused(folder, rf"run\.json: .*{name}")


# ------------------------------------------------------------------------------------------ timings


def test_a_timing_that_is_none_is_refused_and_a_torn_one_is_not_known(tmp_path: Path) -> None:
    timing = EpisodeTiming(
        key=RECORD.key, total_seconds=2.0, reset_seconds=0.5, step_seconds=1.0, inference_seconds=0.5
    )
    with RunFolder.open(tmp_path / "r", description()) as folder:
        folder.append(RECORD, timing)
    path = tmp_path / "r/timings.jsonl"
    whole = path.read_text()
    path.write_text('{"key": {"ta\n' + whole)
    assert read_timings(tmp_path / "r") == {EpisodeKey("A", "oracle", 2, 0, 3): timing}
    for wrong in (
        whole.replace('"seed": 3', '"seed": [3]'),
        whole.replace('"total_seconds": 2.0', '"total_seconds": -2.0'),
        whole.replace('"total_seconds": 2.0', '"total_seconds": NaN'),
        "[]\n",
        whole.replace("reset_seconds", "rest_seconds"),
    ):
        path.write_text(whole + wrong)
        with pytest.raises(RunFolderError, match=r"timings\.jsonl:2: expected the timing of an episode"):
            read_timings(tmp_path / "r")


# ------------------------------------------------------------------------------------------ the folder


def a_folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


def a_loop(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(path.name)


def a_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


@pytest.mark.parametrize("place", [a_folder, a_loop, a_pipe])
@pytest.mark.parametrize("name", ["run.json", "episodes.jsonl", "timings.jsonl"])
def test_what_is_no_file_is_one_message(
    tmp_path: Path, name: str, place: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make(tmp_path / "r", changed())
    place(folder / name)
    with pytest.raises(RunFolderError, match=name.replace(".", r"\.")):
        RunFolder.open(folder, description())
    assert main(["report", str(folder), "--html", str(tmp_path / "page")]) == 1
    assert main(["report", str(folder)]) == (0 if name == "timings.jsonl" else 1)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("name", ["logs", "videos", "rrd"])
def test_a_file_in_the_place_of_a_subfolder_is_one_message(tmp_path: Path, name: str) -> None:
    folder = make(tmp_path / "r", changed())
    (folder / name).touch()
    with pytest.raises(RunFolderError, match=f"{name}: expected a folder, found something else"):
        RunFolder.open(folder, description())
    assert read_run(folder).records == (RECORD,)


@pytest.mark.parametrize("verb", [["report"], ["compare"], ["view", "--print"]])
def test_the_command_line_says_it_in_one_message(
    tmp_path: Path, verb: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make(tmp_path / "r", changed(outcome="banana"))
    assert main([*verb, str(folder)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("mikasa-vla: error: ") and captured.err.count("\n") == 1
    assert "episodes.jsonl:1: expected an episode record, found outcome 'banana'" in captured.err
