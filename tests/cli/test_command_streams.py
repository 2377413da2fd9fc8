"""The command line with streams that cannot be written, odd locales, and paths that are no text."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.evaluation.evaluation_bench import SHORT, TASK
from vla_eval.storage.run_folder import read_run

EVAL = [
    "eval",
    "--task",
    TASK,
    "--policy",
    "random",
    "--episodes",
    "2",
    "--workers",
    "1",
    "--set",
    "simulator=fake",
]
EVAL += [f"--set=env.{name}={value}" for name, value in SHORT.items()]
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii", "PYTHONCOERCECLOCALE": "0"}


def command(
    folder: Path, arguments: list[str | bytes], redirection: str = "", **environment: str
) -> subprocess.CompletedProcess[bytes]:
    """Run the command in a shell, which does the redirection."""
    line = ["bash", "-c", f'"$@" {redirection}', "-", sys.executable, "-m", "vla_eval.cli", *arguments]
    return subprocess.run(
        line, cwd=folder, capture_output=True, env={**os.environ, **environment}, timeout=240
    )


@pytest.mark.parametrize("redirection", ["2>/dev/full", "2>&-"])
def test_an_evaluation_needs_no_standard_error(tmp_path: Path, redirection: str) -> None:
    done = command(tmp_path, [*EVAL, "--out", "out"], redirection)

    assert done.returncode == 0, done.stdout
    assert b"| random" in done.stdout
    assert len(read_run(tmp_path / "out").records) == 2


@pytest.mark.parametrize("redirection", [">/dev/full", ">&-"])
def test_standard_output_that_cannot_be_written_is_one_message_and_costs_no_result(
    tmp_path: Path, redirection: str
) -> None:
    done = command(tmp_path, [*EVAL, "--out", "out"], redirection)

    assert done.returncode == 1
    assert done.stderr.count(b"error: standard output: cannot be written") == 1
    assert b"Traceback" not in done.stderr and b"Exception ignored" not in done.stderr
    assert len(read_run(tmp_path / "out").records) == 2


@pytest.mark.slow
def test_a_folder_s_name_need_be_no_text_and_the_locale_may_be_ascii(tmp_path: Path) -> None:
    out = b"r\xffsults-\xc3\xa9"
    for arguments in ([*EVAL, b"--out", out], ["report", out, "--format", "markdown"]):
        done = command(tmp_path, arguments, **ASCII)

        assert done.returncode == 0, done.stderr.decode(errors="replace")
        assert b"| random" in done.stdout
        assert done.stdout.isascii()
    assert os.path.getsize(os.path.join(os.fsencode(tmp_path), out, b"episodes.jsonl"))
