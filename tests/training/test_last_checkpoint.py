"""`checkpoints/last` may be a link, a folder, or missing: the newest complete step is what counts."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.training.tiny_trainings import act, finetune_losses
from vla_eval.checkpoints.files import find_checkpoint, step_folders
from vla_eval.training.run_folder import NO_LINKS, newest_checkpoint, point


@pytest.fixture
def stopped(recorded: Path, tmp_path: Path, killed_at: Any, small_act: None) -> Iterator[Path]:
    """A run of 4 steps that was killed after its checkpoint of step 2."""
    with killed_at(3):
        finetune_losses(act(recorded, tmp_path / "run"))
    yield tmp_path / "run"


def as_folder(last: Path) -> None:
    target = last.resolve()
    last.unlink()
    shutil.copytree(target, last)


def dangling(last: Path) -> None:
    last.unlink()
    last.symlink_to("000099")


WAYS: dict[str, Callable[[Path], object]] = {
    "a folder, as `cp -rL` makes it": as_folder,
    "missing": Path.unlink,
    "a link to nothing": dangling,
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("way", WAYS)
def test_the_run_resumes_and_its_newest_step_is_found(
    recorded: Path, stopped: Path, tmp_path: Path, way: str
) -> None:
    whole = finetune_losses(act(recorded, tmp_path / "whole"))
    checkpoints = stopped / "train/checkpoints"
    WAYS[way](checkpoints / "last")
    assert find_checkpoint(stopped).parent.name == "000002"
    assert finetune_losses(act(recorded, stopped)) == whole
    assert find_checkpoint(stopped).resolve().parent.name == "000004"
    assert [folder.name for folder in step_folders(checkpoints)] == ["000002", "000004"]


@pytest.mark.parametrize("number", NO_LINKS)
def test_a_run_goes_on_where_there_can_be_no_links(
    recorded: Path,
    tmp_path: Path,
    small_act: None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    number: int,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "symlink_to", refuse)
    if number == errno.EPERM:  # the others go the same way
        finetune_losses(act(recorded, tmp_path / "run"))
        assert find_checkpoint(tmp_path / "run").parent.name == "000004"
        assert not (tmp_path / "run/train/checkpoints/last").exists()
    point(tmp_path / "last", "000004")
    assert "there can be no link here" in caplog.text


def test_another_error_is_not_taken_for_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    with pytest.raises(OSError, match="No space left"):
        point(tmp_path / "last", "000004")


def test_the_highest_step_is_the_newest_whatever_its_number_of_digits(tmp_path: Path) -> None:
    """A run that was extended from 900 to 1200 steps may have both."""
    for name in ("000900", "1000", "999", "last", "00x", "٣"):
        (tmp_path / "train/checkpoints" / name / "training_state").mkdir(parents=True)
    newest = newest_checkpoint(tmp_path)
    assert newest is not None and newest.name == "1000"
