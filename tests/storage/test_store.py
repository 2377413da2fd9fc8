"""The run folder: nothing finished is lost, nothing is counted twice, whatever kills the process."""

import errno
import json
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.storage.run_records import describe, error, result, writer
from vla_eval.errors import RunFolderError, StorageFullError
from vla_eval.records import EpisodeKey, EpisodeTiming
from vla_eval.storage.run_folder import RunFolder, read_run

# ------------------------------------------------------------------------------- what is kept


def test_what_is_appended_is_read_back(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
        folder.append(result(2, success=False))
    stored = read_run(tmp_path / "r")
    assert stored.records == (result(1), result(2, success=False))
    assert stored.description == describe()


def test_a_record_is_synced_before_append_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    write, fsync = os.write, os.fsync
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        monkeypatch.setattr(os, "write", lambda fd, data: calls.append("write") or write(fd, data))
        monkeypatch.setattr(os, "fsync", lambda fd: calls.append("fsync") or fsync(fd))
        folder.append(result(1))
        assert calls == ["write", "fsync"]


def test_errors_are_not_finished(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
        folder.append(error(2))
        assert folder.finished_keys() == {EpisodeKey("A", "oracle", 1, 0, 1)}


def test_errors_are_retried_on_resume_and_the_result_takes_their_place(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(error(1))
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        assert folder.finished_keys() == frozenset()
        folder.append(result(1))
    assert read_run(tmp_path / "r").records == (result(1),)


def test_of_several_errors_the_last_one_is_shown(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(error(1, "first"))
        folder.append(error(1, "second"))
    assert read_run(tmp_path / "r").records == (error(1, "second"),)


def test_a_second_result_is_refused(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(7))
        with pytest.raises(
            RunFolderError, match=r"oracle on A \(n_action_steps 1, run 0, seed 7\) has a result"
        ):
            folder.append(result(7, success=False))


def test_a_second_result_in_the_file_is_refused(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(7))
    with (tmp_path / "r/episodes.jsonl").open("a") as file:
        file.write(result(7).to_json() + "\n")
    with pytest.raises(RunFolderError, match=r"episodes\.jsonl:2: a second result of oracle on A"):
        read_run(tmp_path / "r")


def test_timings_are_kept_beside_the_records(tmp_path: Path) -> None:
    timing = EpisodeTiming(
        key=result(1).key, total_seconds=4.0, reset_seconds=1.0, step_seconds=2.0, inference_seconds=1.0
    )
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1), timing)
    line = json.loads((tmp_path / "r/timings.jsonl").read_text())
    assert line["key"]["seed"] == 1 and line["total_seconds"] == 4.0
    assert "seconds" not in (tmp_path / "r/episodes.jsonl").read_text()


def test_text_that_has_no_utf8_is_kept(tmp_path: Path) -> None:
    # A file name of another encoding is a lone surrogate in Python; UTF-8 has none.
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(error(1, "no such file: \udcff.bin"))
    assert read_run(tmp_path / "r").records == (error(1, "no such file: \udcff.bin"),)


def test_a_closed_folder_takes_nothing(tmp_path: Path) -> None:
    folder = RunFolder.open(tmp_path / "r", describe())
    folder.close()
    folder.close()
    with pytest.raises(RunFolderError, match="closed"):
        folder.append(result(1))


# ------------------------------------------------------------------------------- kill


def test_kill_9_at_any_moment_loses_nothing_and_doubles_nothing(tmp_path: Path) -> None:
    out, n_keys, n_processes = tmp_path / "r", 1500, 8
    moments = random.Random(0)
    exit_codes = []
    for n_before in range(n_processes):
        with subprocess.Popen(writer(out, n_keys), stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            first = process.stdout.readline()  # it is in the middle of its work now
            time.sleep(moments.uniform(0, 0.02 * (n_before + 1)))
            process.send_signal(signal.SIGKILL)
            reported = {int(line) for line in (first, *process.stdout) if line.endswith("\n")}
        exit_codes.append(process.returncode)
        assert reported <= {record.seed for record in read_run(out).records}
    assert -signal.SIGKILL in exit_codes
    subprocess.run(writer(out, n_keys), check=True, stdout=subprocess.DEVNULL)
    lines = (out / "episodes.jsonl").read_text().splitlines()
    assert sorted(json.loads(line)["seed"] for line in lines) == list(range(n_keys))


@pytest.mark.parametrize("n_kept", [1, 40, -2])
def test_a_torn_last_line_is_cut_off(tmp_path: Path, n_kept: int) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
    with (tmp_path / "r/episodes.jsonl").open("a") as file:
        file.write(result(2).to_json()[:n_kept])
    assert read_run(tmp_path / "r").records == (result(1),)
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        assert folder.finished_keys() == {result(1).key}
        folder.append(result(2))
    assert read_run(tmp_path / "r").records == (result(1), result(2))


def test_a_last_line_that_lacks_only_its_end_is_completed(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    (tmp_path / "r/episodes.jsonl").write_text(result(1).to_json())
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(2))
    assert read_run(tmp_path / "r").records == (result(1), result(2))


def test_a_damaged_line_in_the_middle_is_named_and_left_alone(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    content = f"{result(1).to_json()}\n{{broken\n{result(3).to_json()}\n{{torn"
    (tmp_path / "r/episodes.jsonl").write_text(content)
    with pytest.raises(
        RunFolderError, match=r"episodes\.jsonl:2: expected an episode record, found '{broken'"
    ):
        RunFolder.open(tmp_path / "r", describe())
    assert (tmp_path / "r/episodes.jsonl").read_text() == content


def test_bytes_that_are_no_text_are_named(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    (tmp_path / "r/episodes.jsonl").write_bytes(b"\xff\xfe\n")
    with pytest.raises(RunFolderError, match=r"episodes\.jsonl:1: expected an episode record in UTF-8"):
        read_run(tmp_path / "r")


def test_a_whole_last_line_of_another_version_is_not_thrown_away(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    line = result(1).to_json().replace('"record_version": 2', '"record_version": 99')
    (tmp_path / "r/episodes.jsonl").write_text(line)
    with pytest.raises(RunFolderError, match="record version 99"):
        RunFolder.open(tmp_path / "r", describe())
    assert (tmp_path / "r/episodes.jsonl").read_text() == line


@pytest.mark.parametrize("left_behind", [[], ["run.lock"], ["run.lock", "run.json.tmp"]])
def test_a_kill_before_run_json_leaves_a_folder_that_can_be_started(
    tmp_path: Path, left_behind: list[str]
) -> None:
    (tmp_path / "r").mkdir()
    for name in left_behind:
        (tmp_path / "r" / name).write_text("{")
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
    assert read_run(tmp_path / "r").records == (result(1),)


def test_a_kill_between_run_json_and_the_first_episode_is_no_trouble(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    (tmp_path / "r/episodes.jsonl").unlink()
    assert read_run(tmp_path / "r").records == ()
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))


# ------------------------------------------------------------------------------- full disk


def test_a_write_that_fails_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_fd: int, _data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(StorageFullError, match=r"No space left.*[Nn]othing.*lost.*same command again"):
            folder.append(result(2))
        assert folder.finished_keys() == {result(1).key}
        monkeypatch.undo()
        folder.append(result(2))  # space has been freed
    assert read_run(tmp_path / "r").records == (result(1), result(2))


def test_a_short_write_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
        before = (tmp_path / "r/episodes.jsonl").read_bytes()
        monkeypatch.setattr(os, "write", lambda fd, data: write(fd, data[:10]))
        with pytest.raises(StorageFullError, match=r"only 10 of \d+ bytes"):
            folder.append(result(2))
        assert (tmp_path / "r/episodes.jsonl").read_bytes() == before


def test_a_record_that_cannot_be_synced_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = [OSError(errno.EIO, os.strerror(errno.EIO))]
    fsync = os.fsync

    def fail_once(fd: int) -> None:
        if failures:
            raise failures.pop()
        fsync(fd)

    with RunFolder.open(tmp_path / "r", describe()) as folder:
        monkeypatch.setattr(os, "fsync", fail_once)
        with pytest.raises(StorageFullError, match="Input/output error"):
            folder.append(result(1))
        assert (tmp_path / "r/episodes.jsonl").read_bytes() == b""


def test_a_line_that_cannot_be_taken_back_closes_the_file_to_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_args: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    write = os.write
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        monkeypatch.setattr(os, "write", lambda fd, data: write(fd, data[:10]))
        monkeypatch.setattr(os, "ftruncate", fail)
        with pytest.raises(StorageFullError):
            folder.append(result(1))
        monkeypatch.undo()
        with pytest.raises(RunFolderError, match=r"neither be written nor taken back.*same command again"):
            folder.append(result(1))
    with RunFolder.open(tmp_path / "r", describe()) as folder:  # opening repairs it
        folder.append(result(1))


def test_a_timing_that_cannot_be_written_costs_no_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    timing = EpisodeTiming(
        key=result(1).key, total_seconds=4.0, reset_seconds=1.0, step_seconds=2.0, inference_seconds=1.0
    )
    write = os.write

    def only_records(fd: int, data: bytes) -> int:
        if b"total_seconds" in data:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(fd, data)

    with RunFolder.open(tmp_path / "r", describe()) as folder:
        monkeypatch.setattr(os, "write", only_records)
        folder.append(result(1), timing)
    assert read_run(tmp_path / "r").records == (result(1),)


def test_a_file_size_limit_ends_the_run_cleanly_and_it_goes_on_without(tmp_path: Path) -> None:
    # A real refusal by the kernel: at the limit a write is short, beyond it EFBIG (Python ignores SIGXFSZ).
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))\n"
    command = writer(tmp_path / "r", 100)
    command[2] = limit + command[2]
    limited = subprocess.run(command, capture_output=True, text=True, check=False)
    assert limited.returncode == 1 and "StorageFullError" in limited.stderr
    data = (tmp_path / "r/episodes.jsonl").read_bytes()
    n_reported = len(limited.stdout.splitlines())
    assert data.endswith(b"\n") and data.count(b"\n") == n_reported and 0 < n_reported < 100
    subprocess.run(writer(tmp_path / "r", 100), check=True, stdout=subprocess.DEVNULL)
    assert len(read_run(tmp_path / "r").records) == 100
