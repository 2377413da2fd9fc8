"""What every conversion of a checkpoint does: a whole folder or none."""

from pathlib import Path

import pytest

from vla_eval.checkpoints.conversion import folder_when_whole
from vla_eval.errors import CheckpointError


def test_a_folder_that_was_not_finished_has_not_got_its_name_and_the_next_try_begins_anew(
    tmp_path: Path,
) -> None:
    out = tmp_path / "checkpoint"
    with pytest.raises(OSError, match="disk"), folder_when_whole(out) as folder:
        (folder / "half").touch()
        raise OSError("the disk is full")
    assert not out.exists()
    with folder_when_whole(out) as folder:
        (folder / "whole").touch()
    assert [path.name for path in out.iterdir()] == ["whole"]
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


def test_a_folder_that_is_there_is_left_alone(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="exists already"), folder_when_whole(tmp_path):
        pass
