"""`reproduce`: claims are read with their conditions, and the verdict depends on seeds and outcomes alone."""

import json
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.main import main
from vla_eval.cli.reproduce import outcomes
from vla_eval.errors import RecipeError
from vla_eval.results.claimed.claims import read_claim
from vla_eval.storage.run_folder import read_run

pytestmark = pytest.mark.usefixtures("in_this_process")

COLOR, SHELL = "RememberColor3-v0", "ShellGameTouch-v0"
FAKE = ("--workers", "1", "--set", "simulator=fake")


def reproduce(*arguments: str) -> int:
    return main(["reproduce", *arguments])


def verdict(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    capsys.readouterr()
    code = reproduce(*arguments, *FAKE, "--format", "json")
    found: dict[str, Any] = {**json.loads(capsys.readouterr().out), "code": code}
    return found


@pytest.fixture(scope="module")
def claimed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("claim") / "run"
    command = ["eval", "--task", COLOR, "--policy", "oracle", "cue_blind", "--n-action-steps", "2", "4"]
    settings = ("--set", "env.delay_steps=7", "--set", "chunking.delay=1")
    assert main([*command, "--episodes", "20", "--out", str(out), *FAKE, *settings]) == 0
    return out


def test_a_policy_as_good_as_claimed_is_accepted_under_the_claims_conditions(
    claimed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of = (str(claimed), "--of", "oracle", "--n-action-steps", "4", "--loss", "0.2")
    found = verdict(capsys, *of, "--policy", "oracle", "--out", str(tmp_path / "new"))
    assert (found["code"], found["verdict"]) == (0, "reproduced")
    assert found["claim"]["n_success"] == found["claim"]["n_episodes"] == 20
    old, new = read_run(claimed), read_run(tmp_path / "new")
    for name in ("env", "chunking", "render", "prompt_set", "simulator"):
        assert new.description.config[name] == old.description.config[name]
    assert new.description.config["n_action_steps"] == [4]
    assert not {one.seed for one in new.records} & {one.seed for one in old.records}
    # The same command again: nothing runs, and the verdict is the same.
    assert verdict(capsys, *of, "--policy", "oracle", "--out", str(tmp_path / "new")) == found


def test_a_worse_policy_is_below_the_claim_after_few_episodes(
    claimed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of = (str(claimed), "--of", "oracle", "--n-action-steps", "4", "--loss", "0.2")
    found = verdict(capsys, *of, "--policy", "cue_blind", "--out", str(tmp_path / "new"))
    assert (found["code"], found["verdict"]) == (4, "below")
    assert found["n_episodes"] < found["most_episodes"] and found["p_value"] < 0.05
    # Another policy in the same folder is refused, whatever the verdict there is.
    capsys.readouterr()
    assert reproduce(*of, "--policy", "oracle", "--out", str(tmp_path / "new"), *FAKE) == 1
    assert "Anything else goes into a folder beside it" in capsys.readouterr().err


def test_without_a_verdict_it_is_not_decided(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    claim = ("30/100", "--task", COLOR, "--n-action-steps", "4", "--loss", "0.25", "--power", "0.1")
    found = verdict(capsys, *claim, "--policy", "cue_blind", "--out", str(tmp_path / "new"))
    assert found["code"] == {"reproduced": 0, "below": 4, "open": 5}[found["verdict"]]
    assert (found["verdict"] == "open") == (found["n_episodes"] == found["most_episodes"])


@pytest.mark.parametrize("workers", ["1", "2"])
def test_the_verdict_does_not_depend_on_the_number_of_workers(
    workers: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    claim = ("95/100", "--task", COLOR, "--n-action-steps", "4", "--loss", "0.2", "--policy", "cue_blind")
    rows = ("--out", str(tmp_path / workers), "--set", "simulator=fake", "--format", "json")
    assert reproduce(*claim, *rows, "--workers", workers) == 4
    found = json.loads(capsys.readouterr().out)
    run = read_run(tmp_path / workers)
    first = [one.outcome == "success" for one in sorted(run.records, key=lambda one: one.seed)]
    assert found["n_success"] == sum(first[: found["n_episodes"]])


def test_only_seeds_without_a_gap_count(claimed: Path) -> None:
    every = read_run(claimed).records
    records = [one for one in every if (one.policy, one.n_action_steps) == ("oracle", 2)]
    assert outcomes(records, seed_start=1) == [True] * 20
    assert outcomes(reversed(records), seed_start=1) == [True] * 20
    assert outcomes([one for one in records if one.seed != 6], seed_start=1) == [True] * 5
    assert outcomes(records, seed_start=21) == []


def test_a_published_row_is_a_claim_with_its_notes() -> None:
    row = read_claim("leaderboard_mikasa/memory", task="RememberColor9-v0")
    assert (row.claim.n_success, row.claim.n_episodes, row.n_action_steps) == (97, 100, 4)
    assert any("simplified mesh" in note for note in row.notes)
    with pytest.raises(RecipeError, match="does not say of how many episodes"):
        read_claim("GMP", task=COLOR)  # perhaps 100, which is not taken as known
    several = read_claim("OpenVLA", task=COLOR, n_action_steps=8)
    assert (several.claim.n_success, several.claim.n_episodes) == (59, 100)
    assert any("mean of 3 trainings" in note for note in several.notes)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("9/10",), "of which task"),
        (("11/10", "--task", COLOR), "expected 0 to n_episodes"),
        (("leaderboard_mikasa/memory",), "expected one claim, found"),
        (("leaderboard_mikasa/Memory",), "Did you mean 'leaderboard_mikasa/memory'"),
        (("OpenVLA", "--task", COLOR), "Choose one with --task, --n-action-steps"),
        (("OpenVLA", "--task", COLOR, "--n-action-steps", "7"), "expected a rate with task"),
        (("Chameleon",), "found a mean alone"),
        (("ELMUR", "--task", COLOR), "does not say of how many episodes"),
        (("5/10", "--task", COLOR), "Use a loss above"),
        (("100/100", "--task", COLOR, "--power", "1"), "between 0 and 1"),
        (("100/100", "--task", COLOR, "--loss", "0"), "between 0 and 1"),
        (("100/100", "--task", COLOR, "--episodes", "0"), "expected 1 to"),
        (("100/100", "--task", COLOR, "--set", "runs=3"), "the test is of one run"),
        (("100/100", "--task", COLOR, "--set", "n_action_steps=[1, 4]"), "a claim is of one, found 1, 4"),
        (
            ("100/100", "--task", COLOR, "--set", f"tasks=[{COLOR}, {SHELL}]"),
            "--set tasks: a claim is of one",
        ),
    ],
)
def test_a_mistake_is_one_message(
    arguments: tuple[str, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reproduce(*arguments, "--policy", "oracle", "--out", str(tmp_path), *FAKE) == 1
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "expected one claim, found"),
        (("--of", "orcale"), "Did you mean 'oracle'"),
        (("--of", "oracle", "--task", SHELL), f"found oracle on {COLOR} K=2"),
        (
            ("--of", "oracle", "--n-action-steps", "4", "--seed-start", "1", "--loss", "0.3"),
            "--seed-start 21",
        ),
    ],
)
def test_a_claim_of_a_run_that_is_none_is_one_message(
    arguments: tuple[str, ...], says: str, claimed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reproduce(str(claimed), "--policy", "oracle", *arguments, "--out", str(tmp_path), *FAKE) == 1
    assert says in capsys.readouterr().err


def test_a_claim_of_another_version_of_the_task_is_refused(
    claimed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old"
    old.mkdir()
    for name in ("run.json", "episodes.jsonl"):
        text = (claimed / name).read_text(encoding="utf-8")
        (old / name).write_text(text.replace(f'"{COLOR}": 1', f'"{COLOR}": 7'), encoding="utf-8")
    assert reproduce(str(old), "--of", "oracle", "--n-action-steps", "4", "--policy", "oracle", *FAKE) == 1
    assert "version 7 of the task" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "code"), [((), 0), (("--set", "reset_policy_at_step=8"), 4)], ids=["as shipped", "forgets"]
)
def test_the_shipped_policy_is_accepted_and_its_twin_that_forgets_is_not(
    settings: tuple[str, ...], code: int, tmp_path: Path
) -> None:
    claim = ("leaderboard_mikasa/memory", "--task", COLOR, "--policy", "memory_color3")
    measured = ("--set", "render.wrist_mesh=simplified", "--out", str(tmp_path))
    assert reproduce(*claim, *measured, *settings) == code
