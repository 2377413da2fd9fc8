"""`mikasa-vla serve` as a person runs it."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

from vla_eval.cli.main import main


def test_it_prints_its_address_serves_and_stops_on_sigterm() -> None:
    command = (sys.executable, "-m", "vla_eval.cli", "serve", "--policy", "random", "--port", "0")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.fullmatch(r"Serving random at ws://(127\.0\.0\.1:[1-9]\d*)\n", line)
            assert found, line
            with urllib.request.urlopen(f"http://{found[1]}/healthz", timeout=10) as answer:
                assert answer.read() == b"OK\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
            assert process.stderr is not None and process.stderr.read() == ""
        finally:
            process.kill()


def test_a_key_that_is_not_set_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    os.environ.pop("NO_SUCH_KEY", None)
    assert main(["serve", "--policy", "random", "--api-key-env", "NO_SUCH_KEY"]) == 1
    assert "--api-key-env NO_SUCH_KEY: expected a key in this variable" in capsys.readouterr().err


def test_an_open_address_without_a_key_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--policy", "oracle", "--host", "0.0.0.0"]) == 1
    errors = capsys.readouterr().err
    assert errors.startswith("warning: 0.0.0.0 can be reached from other machines, and no key is asked for")
    assert "reads the true state of the world" in errors


@pytest.mark.parametrize("flags", [["--port", "70000"], ["--port", "-1"], ["--idle-seconds", "0"]])
def test_a_number_out_of_its_range_is_a_mistake(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--policy", "random", *flags]) == 1
    assert "expected a number" in capsys.readouterr().err


def test_it_computes_with_one_thread_as_workers_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for wanted, expected in ((None, "1"), ("3", "3")):
        monkeypatch.setenv("OMP_NUM_THREADS", "restored by monkeypatch")
        monkeypatch.delenv("OMP_NUM_THREADS")
        if wanted is not None:
            monkeypatch.setenv("OMP_NUM_THREADS", wanted)
        assert main(["serve", "--policy", "oracle"]) == 1
        assert os.environ["OMP_NUM_THREADS"] == expected
