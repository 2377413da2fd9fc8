"""`merge` on the command line: what it refuses before it writes, and its exit codes."""

from pathlib import Path

import pytest

from tests.storage.run_records import error
from tests.storage.test_merging import write_shard
from vla_eval.cli.main import main
from vla_eval.storage.run_folder import RunFolder, read_run


def test_what_is_missing_is_refused_with_nothing_written_unless_it_is_allowed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shard = write_shard(tmp_path, 1)
    command = ["merge", str(shard), "--out", str(tmp_path / "out")]

    assert main(command) == 1
    assert "no folder of shard 2/2 was named" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*command, "--allow-missing"]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'out'}: 2 episodes of 1 shards\n"
    assert "no folder of shard 2/2 was named" in captured.err


def test_episodes_that_ended_in_an_error_give_the_exit_code_of_eval(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shards = [write_shard(tmp_path, 1), write_shard(tmp_path, 2, seeds=(1,))]
    with RunFolder.open(shards[1], read_run(shards[1]).description) as folder:
        folder.append(error(3))

    assert main(["merge", *map(str, shards), "--out", str(tmp_path / "out")]) == 3
    assert capsys.readouterr().out == f"{tmp_path / 'out'}: 4 episodes of 2 shards, 1 of them errors\n"


def test_a_folder_that_is_no_run_folder_is_a_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["merge", str(tmp_path / "nothing"), "--out", str(tmp_path / "out")]) == 1
    assert "is not a run folder" in capsys.readouterr().err


def test_a_second_merge_to_the_same_place_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shards = [str(write_shard(tmp_path, number)) for number in (1, 2)]
    command = ["merge", *shards, "--out", str(tmp_path / "out")]

    assert main(command) == 0
    assert main(command) == 1
    assert "exists already" in capsys.readouterr().err
