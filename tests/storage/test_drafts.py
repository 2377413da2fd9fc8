"""A folder that appears whole or not at all, and what is said where the disk is full."""

import errno
from pathlib import Path

import pytest
from safetensors import SafetensorError

from vla_eval.errors import CheckpointError, LockedError, StorageFullError
from vla_eval.storage.drafts import whole_folder
from vla_eval.storage.durable import on_disk, storage_full

FULL = OSError(errno.ENOSPC, "No space left on device")
OF_SAFETENSORS = SafetensorError("I/O error: No space left on device (os error 28)")
WORDS = "could not be written .No space left on device.*Free some space and run the same command again"


def test_a_folder_that_was_not_finished_has_not_got_its_name_and_the_next_try_begins_anew(
    tmp_path: Path,
) -> None:
    out = tmp_path / "checkpoint"
    with pytest.raises(ValueError, match="half"), whole_folder(out, error=CheckpointError) as folder:
        folder.mkdir()
        (folder / "half").touch()
        raise ValueError("half")
    assert not list(tmp_path.iterdir())
    with whole_folder(out, error=CheckpointError) as folder:
        folder.mkdir()
        (folder / "whole").touch()
    assert [path.name for path in out.iterdir()] == ["whole"]
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


def test_a_folder_that_is_there_is_left_alone(tmp_path: Path) -> None:
    with (
        pytest.raises(CheckpointError, match="exists already"),
        whole_folder(tmp_path, error=CheckpointError),
    ):
        pass


@pytest.mark.parametrize("cause", [FULL, OF_SAFETENSORS])
def test_a_full_disk_is_named_whoever_has_met_it(cause: Exception, tmp_path: Path) -> None:
    with pytest.raises(StorageFullError, match=WORDS), on_disk(tmp_path):
        raise cause
    with (
        pytest.raises(StorageFullError, match=WORDS),
        whole_folder(tmp_path / "x", error=CheckpointError) as folder,
    ):
        folder.mkdir()
        raise cause
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "other", [OSError(errno.EACCES, "Permission denied"), ValueError("28"), KeyError("x")]
)
def test_other_errors_stay_what_they_are(other: Exception, tmp_path: Path) -> None:
    with pytest.raises(type(other)) as found, on_disk(tmp_path):
        raise other
    assert found.value is other


def test_what_may_not_be_written_is_not_a_full_disk(tmp_path: Path) -> None:
    said = str(storage_full(tmp_path, OSError(errno.EACCES, "Permission denied")))
    assert "Make it writable and run the same command again" in said and "space" not in said


def test_what_the_lock_refuses_is_no_full_disk(tmp_path: Path) -> None:
    said = str(storage_full(tmp_path, LockedError("refused to write. Run it with --no-lock.")))
    assert "Name its folder in the command" in said and "--no-lock" in said
    assert "Free some space" not in said
