"""How far a player without memory gets, and what is concluded from it."""

import json
from pathlib import Path

import pytest

from vla_eval.audit.base_audit import MOSTLY_NOT, NEEDS, NOT_KNOWN, NOT_OBSERVED, UNDECIDED, audit_base_task
from vla_eval.cli.main import main

pytestmark = pytest.mark.usefixtures("light_workers")

NAMES = ("MemoryLengthEasy", "Numpad-Discrete", "BattleshipEasy")
BIT, NUMPAD, SHIPS = (f"mikasa_base/{name}-v0" for name in NAMES)


def _returns(random: float, memoryless: float, oracle: float, n: int = 40) -> dict[str, dict[int, float]]:
    levels = {"random": random, "memoryless": memoryless, "oracle": oracle}
    return {name: {seed: value + 0.01 * (seed % 2) for seed in range(n)} for name, value in levels.items()}


@pytest.mark.parametrize(
    ("memoryless", "verdict"),
    [(0.0, NEEDS), (0.5, NEEDS), (0.89, NEEDS), (0.91, MOSTLY_NOT), (1.0, MOSTLY_NOT)],
)
def test_the_share_is_the_way_from_random_to_the_oracle(memoryless: float, verdict: str) -> None:
    # Random at 1, the oracle at 3: the share is that of a way of 2.
    audit = audit_base_task(BIT, _returns(1.0, 1.0 + 2 * memoryless, 3.0))
    assert audit.share == pytest.approx(memoryless)
    assert audit.share_low == pytest.approx(memoryless) and audit.share_high == pytest.approx(memoryless)
    assert audit.verdict == (verdict,)


def test_seeds_that_not_all_have_run_are_in_no_share() -> None:
    returns = _returns(0.0, 0.5, 1.0, n=4)
    returns["oracle"] |= {seed: 100.0 for seed in range(50, 60)}
    audit = audit_base_task(BIT, returns)
    assert audit.share == pytest.approx(0.5)
    assert audit.returns["oracle"].n_episodes == 14


def test_what_varies_too_much_or_was_not_run_is_undecided() -> None:
    returns = _returns(0.0, 0.0, 1.0)
    returns["memoryless"] = {seed: 1.0 if seed % 4 else 0.6 for seed in range(40)}  # 0.9 on average
    assert audit_base_task(BIT, returns).verdict == (UNDECIDED,)
    assert audit_base_task(BIT, {}).verdict == (UNDECIDED,)


def test_a_task_without_a_known_player_gets_no_verdict_and_one_that_hides_actions_says_so() -> None:
    returns = _returns(0.0, 0.0, 1.0)
    del returns["memoryless"]
    assert audit_base_task(NUMPAD, returns).verdict == (NOT_KNOWN,)
    assert audit_base_task(SHIPS, _returns(0.0, 0.0, 1.0)).verdict == (NEEDS, NOT_OBSERVED)


def test_the_audit_runs_its_controls_and_prints_a_row_per_task(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["audit", "--task", BIT, NUMPAD, "--episodes", "8", "--out", str(tmp_path), "--workers", "1"]
    assert main([*command, "--format", "json"]) == 0
    bit, numpad = json.loads(capsys.readouterr().out)
    assert bit["task"] == BIT and set(bit["returns"]) == {"random", "memoryless", "oracle"}
    assert bit["returns"]["oracle"] == {"n_episodes": 8, "mean": 1.0, "low": 1.0, "high": 1.0}
    assert set(numpad["returns"]) == {"random", "oracle"} and numpad["share"] is None
    assert main(command) == 0
    assert "| MemoryLengthEasy-v0 |" in capsys.readouterr().out


def test_only_the_controls_that_were_asked_for_are_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["audit", "--task", BIT, "--episodes", "2", "--out", str(tmp_path), "--workers", "1"]
    assert main([*command, "--control", "oracle", "random", "--format", "json"]) == 0
    (bit,) = json.loads(capsys.readouterr().out)
    assert set(bit["returns"]) == {"random", "oracle"}
    assert bit["share"] is None and bit["verdict"] == [UNDECIDED]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--control", "orcale"], "did you mean 'oracle'"),
        (["--control", "cue_blind"], "control"),
        (["--protocol", "strict"], "no arm to hold"),
        (["--set", "name=mine"], "--set name: an audit sets this field itself"),
        (["--set", "policies=[oracle]"], "--set policies: an audit sets this field itself"),
        (["--set", "workers=2"], "--set workers: an audit sets this field itself"),
    ],
)
def test_what_an_audit_of_mikasa_base_cannot_do_is_refused_in_one_line(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["audit", "--task", BIT, "--out", str(tmp_path / "out"), *flags]) == 1
    said = capsys.readouterr().err
    assert message in said.lower() if message.startswith("did") else message in said
    assert not (tmp_path / "out").exists()


def test_where_the_oracle_is_no_better_than_random_there_is_no_share() -> None:
    audit = audit_base_task(BIT, _returns(1.0, 0.5, 1.0))
    assert audit.share is None and audit.verdict == (UNDECIDED,)
    json.dumps(audit.share_low, allow_nan=False)
