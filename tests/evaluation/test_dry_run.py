"""A dry run of an evaluation counts what is left, and changes nothing."""

import dataclasses
from pathlib import Path

import pytest

from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.dry_run import AssumedRates, evaluation_effort
from vla_eval.evaluation.evaluate import evaluate


def config() -> EvalConfig:
    return EvalConfig(
        name="dry",
        tasks=("RememberColor3-v0",),
        policies=("oracle", "random"),
        n_action_steps=(1, 7),
        episodes=2,
        simulator="fake",
        workers=1,
    )


def test_steps_inferences_and_frames_are_those_of_episodes_without_a_result(tmp_path: Path) -> None:
    out = tmp_path / "run"
    effort = evaluation_effort(config(), out=out)
    assert not out.exists()
    assert (effort.n_episodes, effort.n_finished) == (8, 0)  # 2 policies, 2 numbers of steps, 2 seeds
    assert effort.n_steps == 8 * 60
    assert effort.n_inferences == 4 * 60 + 4 * 9  # 60 steps by sevens are nine inferences
    assert effort.n_frames == 2 * effort.n_inferences and effort.n_learned_inferences == 0
    evaluate(config(), out=out)
    after = evaluation_effort(config(), out=out)
    assert (after.n_episodes, after.n_finished, after.n_steps) == (8, 8, 0)


def test_a_policy_that_is_shown_every_frame_has_a_frame_of_each_step() -> None:
    learned = dataclasses.replace(config(), policies=("memory_color3", "oracle"), n_action_steps=(6,))
    effort = evaluation_effort(learned, out=Path("nowhere"))
    assert effort.n_inferences == 4 * 10 and effort.n_learned_inferences == 2 * 10
    assert effort.n_frames == 2 * (2 * 60 + 2 * 10)  # cameras, episodes, steps or inferences


def test_hours_are_those_of_the_stated_rates() -> None:
    effort = evaluation_effort(config(), out=Path("nowhere"))
    assert effort.seconds(AssumedRates(steps_per_second=10, inference_seconds=1)) == pytest.approx(48)


def test_the_command_prints_what_would_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "--task",
        "RememberColor3-v0",
        "--policy",
        "oracle",
        "--episodes",
        "5",
        "--n-action-steps",
        "4",
    ]
    assert main(["eval", *arguments, "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert "5 to run, 0 of 5 have a result" in printed
    assert "300 control steps, 75 inferences, 150 frames" in printed and "assumptions:" in printed
    assert list(tmp_path.iterdir()) == []
