"""A start that failed leaves no folder behind, and takes nothing with it that it did not make."""

from pathlib import Path

import pytest

from vla_eval.data.recording.folder import RecordingFolder
from vla_eval.errors import RecipeError
from vla_eval.storage.run_file import RunDescription
from vla_eval.storage.starting import StartedFolder

OWN = ("run.json", "lock")


def begin(folder: Path) -> StartedFolder:
    start = StartedFolder(folder, own=OWN)
    (folder / "logs").mkdir(parents=True)
    (folder / "logs" / "worker-0.log").touch()
    (folder / "run.json").touch()
    return start


def test_folders_that_were_made_are_removed_up_to_the_first_that_was_there(tmp_path: Path) -> None:
    start = begin(tmp_path / "runs" / "a")
    start.undo()
    assert list(tmp_path.iterdir()) == []


def test_folders_without_a_file_in_them_are_removed(tmp_path: Path) -> None:
    start = begin(tmp_path / "a")
    (tmp_path / "a" / "task" / "shards").mkdir(parents=True)
    start.undo()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("unknown", ["notes.txt", "task/attempts.jsonl", "logs/notes.txt"])
def test_what_it_does_not_know_keeps_the_whole_folder(tmp_path: Path, unknown: str) -> None:
    start = begin(tmp_path / "a")
    (tmp_path / "a" / unknown).parent.mkdir(exist_ok=True)
    (tmp_path / "a" / unknown).touch()
    start.undo()
    assert (tmp_path / "a" / unknown).exists() and (tmp_path / "a" / "run.json").exists()


def test_a_link_to_a_folder_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    start = begin(tmp_path / "a")
    (tmp_path / "a" / "task").symlink_to(tmp_path / "other")
    start.undo()
    assert (tmp_path / "other").exists() and (tmp_path / "a" / "task").exists()


def test_what_was_there_before_stays(tmp_path: Path) -> None:
    (tmp_path / "a" / "old").mkdir(parents=True)
    start = begin(tmp_path / "a")
    start.undo()
    assert [entry.name for entry in (tmp_path / "a").iterdir()] == ["old"]


@pytest.fixture
def description() -> RunDescription:
    return RunDescription(name="x", config={}, recipes={}, environment={}, options={}, command="record")


def test_a_recording_that_fails_before_its_first_attempt_leaves_nothing(
    tmp_path: Path, description: RunDescription
) -> None:
    out = tmp_path / "data" / "out"
    with (
        pytest.raises(RecipeError, match="no such argument"),
        RecordingFolder.open(out, description, allow_environment_change=False) as folder,
    ):
        (folder.logs() / "worker-0.log").touch()
        folder.attempts("task")
        raise RecipeError("no such argument")
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_is_refused_when_it_goes_on_stays(
    tmp_path: Path, description: RunDescription
) -> None:
    with RecordingFolder.open(tmp_path, description, allow_environment_change=False):
        pass
    with (
        pytest.raises(RecipeError),
        RecordingFolder.open(tmp_path, description, allow_environment_change=False),
    ):
        raise RecipeError("a mistake")
    assert (tmp_path / "recording" / "run.json").exists()
