"""Random lines and files in a run folder: they are accepted, or refused with a message."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.json_cases import BYTES, VALUES, accepted_or_refused, as_bytes, near
from tests.storage.run_records import describe
from tests.storage.test_strict_records import CONFIG, RECORD, VALID
from vla_eval.cli.main import main
from vla_eval.records import EpisodeTiming
from vla_eval.results.report import build_table, render
from vla_eval.storage.run_folder import RunFolder, read_run
from vla_eval.storage.timings import read_timings

EPISODES, RUN, TIMINGS = "episodes.jsonl", "run.json", "timings.jsonl"
TIMING = EpisodeTiming(
    key=RECORD.key, total_seconds=2.0, reset_seconds=0.5, step_seconds=1.0, inference_seconds=0.5
)
DESCRIPTION = describe(config=CONFIG)


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with one episode."""
    path = tmp_path_factory.mktemp("valid") / "run"
    with RunFolder.open(path, DESCRIPTION) as folder:
        folder.append(RECORD, TIMING)
    return path


def put(valid: Path, folder: Path, name: str, content: bytes) -> Path:
    """Make `folder` what `valid` is, but for the content of one file."""
    folder.mkdir(exist_ok=True)
    for file in (EPISODES, RUN, TIMINGS):
        (folder / file).write_bytes(content if file == name else (valid / file).read_bytes())
    return folder


@pytest.fixture(autouse=True)
def without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here is about power cuts, and each case would wait for several of these."""
    monkeypatch.setattr(os, "fsync", lambda fd: None)


def read_and_resume(folder: Path, name: str) -> None:
    """Read the folder as report, page and resume do; what is refused stays as it is."""

    def report() -> None:
        table = build_table([read_run(folder)])
        for fmt in ("markdown", "csv", "json", "latex"):
            render(table, fmt)  # type: ignore[arg-type]  # one of them

    def resume() -> None:
        RunFolder.open(folder, DESCRIPTION).close()

    accepted_or_refused((lambda: read_timings(folder)) if name == TIMINGS else report)
    before = {name: (folder / name).read_bytes() for name in (EPISODES, RUN)}
    if not accepted_or_refused(resume):
        assert {name: (folder / name).read_bytes() for name in before} == before


RUN_DATA = {**{"format_version": 1, "name": "demo", "config": CONFIG, "recipes": {"policies/oracle": "aa"}}}
RUN_DATA |= {"environment": {"commit": "c1"}, "options": {"workers": 2}, "command": "", "normalization": {}}
SESSION = {"started_at": "2030", "command": "", "options": {}, "environment_changes": []}
RUN_DATA |= {"sessions": [SESSION]}
TIMING_DATA = {"key": RECORD.key._asdict(), "total_seconds": 2.0, "reset_seconds": 0.5}
TIMING_DATA |= {"step_seconds": 1.0, "inference_seconds": 0.5}
SESSIONS = st.lists(near(SESSION), max_size=2).map(lambda sessions: {**RUN_DATA, "sessions": sessions})
CONFIGS = near(CONFIG).map(lambda config: {**RUN_DATA, "config": config})
FILES: dict[str, st.SearchStrategy[Any]] = {
    EPISODES: near(VALID),
    RUN: near(RUN_DATA) | SESSIONS | CONFIGS,
    TIMINGS: near(TIMING_DATA),
}


@pytest.mark.parametrize(("name", "data"), [(EPISODES, VALID), (RUN, RUN_DATA), (TIMINGS, TIMING_DATA)])
def test_what_is_valid_is_accepted(valid: Path, tmp_path: Path, name: str, data: dict[str, Any]) -> None:
    folder = put(valid, tmp_path / "run", name, as_bytes(data) + b"\n")
    assert read_run(folder).records == (RECORD,)
    assert read_timings(folder) == {RECORD.key: TIMING}
    RunFolder.open(folder, DESCRIPTION).close()


@given(data=st.data())
@pytest.mark.parametrize("name", FILES)
def test_other_json_is_accepted_or_refused_with_a_message(
    valid: Path, tmp_path: Path, name: str, data: Any
) -> None:
    content = as_bytes(data.draw(FILES[name] | VALUES)) + b"\n"
    read_and_resume(put(valid, tmp_path / "run", name, content), name)


@given(content=BYTES, cut=st.integers(min_value=0, max_value=600))
@pytest.mark.parametrize("name", FILES)
def test_other_bytes_are_accepted_or_refused_with_a_message(
    valid: Path, tmp_path: Path, name: str, content: bytes, cut: int
) -> None:
    whole = (valid / name).read_bytes()
    for damaged in (content, whole[:cut] + content + whole[cut + 1 :]):
        read_and_resume(put(valid, tmp_path / "run", name, damaged), name)


@pytest.mark.sampled(4)
@settings(max_examples=30)
@given(data=st.data())
@pytest.mark.parametrize(
    "verb", [["report"], ["report", "--format", "csv"], ["compare"], ["view", "--print"]]
)
def test_the_command_line_prints_it_or_one_message(
    valid: Path, tmp_path: Path, verb: list[str], data: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    name = data.draw(st.sampled_from((EPISODES, RUN)))
    content = as_bytes(data.draw(FILES[name])) + b"\n"
    folder = put(valid, tmp_path / "run", name, content)
    code = main([*verb, str(folder)])
    captured = capsys.readouterr()
    assert code in (0, 1)
    assert (code == 1) == captured.err.startswith("mikasa-vla: error: ")
    assert "Traceback" not in captured.err


def test_a_resumed_evaluation_says_it_in_one_message_and_leaves_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two cases, since each starts an evaluation, and the first a worker."""
    out = tmp_path / "run"
    command = ["eval", "--task", "RememberColor3-v0", "--policy", "hold", "--episodes", "1", "--workers", "1"]
    command += ["--set", "simulator=fake", "--n-action-steps", "1", "--out", str(out)]
    assert main(command) == 0
    sound = json.loads((out / EPISODES).read_bytes())
    for change in ({"outcome": "banana"}, {"seed": 99}):
        damaged = as_bytes({**sound, **change}) + b"\n"
        (out / EPISODES).write_bytes(damaged)
        capsys.readouterr()
        assert main(command) == 1
        error = capsys.readouterr().err
        assert "mikasa-vla: error: " in error and str(out / EPISODES) in error and "Traceback" not in error
        assert (out / EPISODES).read_bytes() == damaged
