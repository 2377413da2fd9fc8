"""`eval --protocol`: what it sets, what is recorded, what is printed."""

import json
from pathlib import Path

import pytest

from vla_eval.cli.main import main

PROTOCOL = """
name: small
version: 1
description: one task, two seeds
source: here
tasks: {RememberColor3-v0: 1}
episodes: 2
seed_start: 7
n_action_steps: [4]
"""


def test_a_protocol_sets_tasks_seeds_and_k_and_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "protocols").mkdir()
    (tmp_path / "protocols" / "small.yaml").write_text(PROTOCOL)
    words = ("--policy", "random", "--set", "simulator=fake", "--workers", "1", "--out", "run")
    assert main(["eval", "--protocol", "small", *words]) == 0
    # The fake simulator is no setting of a protocol.
    assert "| small v1 | random | 4 | not the protocol |" in squeezed(capsys.readouterr().out)
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    config = run["config"]
    assert run["options"]["protocol"] == "small"
    assert (config["tasks"], config["episodes"], config["seed_start"]) == (["RememberColor3-v0"], 2, 7)
    assert config["n_action_steps"] == [4]
    assert main(["report", "run", "--format", "json"]) == 0  # the run names its protocol
    (row,) = json.loads(capsys.readouterr().out)["protocols"]
    assert (row["mean"], row["departures"]) == (None, ["simulator=fake"])


def test_a_mistyped_protocol_is_one_message(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--protocol", "leaderbord_mikasa", "--policy", "random"]) == 1
    assert "Did you mean 'leaderboard_mikasa'?" in capsys.readouterr().err


def squeezed(text: str) -> str:
    return " ".join(text.split())
