"""What people type for what they mean: each gets a reply that names what is meant, or is understood."""

import json
from pathlib import Path

import pytest

from vla_eval.cli.main import build_parser, main

EVAL = "eval --task RememberColor3-v0 --policy oracle --set simulator=fake"
# Command line -> words that its reply must have.
SLIPS = {
    f"{EVAL} --seed 5": "Did you mean '--seed-start'?",
    f"{EVAL} --seeds 1-5": "Did you mean '--seed-start'?",
    f"{EVAL} --device cuda": "args: {device: cuda}",
    f"{EVAL} --gpu 0": "args: {device: cuda}",
    f"{EVAL} --n-episodes 5": "Did you mean '--episodes'?",
    f"{EVAL} --num-workers 2": "Did you mean '--workers'?",
    f"{EVAL} --chunk-size 4": "Did you mean '--n-action-steps'?",
    f"{EVAL} --output-dir x": "Did you mean '--out'?",
    f"{EVAL} --video all": "Did you mean '--capture-video'?",
    f"{EVAL} --resume": "The same command again resumes.",
    f"{EVAL} --config x.yaml": "mikasa-vla eval configs/mine.yaml",
    f"{EVAL} --format tex": "Did you mean 'latex'?",
    f"{EVAL} --format md": "Did you mean 'markdown'?",
    f"{EVAL} --n-action-steps 1,x": "expected whole numbers such as 1 4 8",
    f"{EVAL} --set delay_steps=20": "Did you mean 'env.delay_steps' or 'chunking.delay_steps'?",
    f"{EVAL} --set cue_steps=20": "Did you mean 'env.cue_steps'?",
    f"{EVAL} --set horizon_steps=90": "Did you mean 'env.horizon_steps'?",
    f"{EVAL} --set backend=gpu": "Did you mean 'render.backend'?",
    f"{EVAL} --set episdes=5": "Did you mean 'episodes'?",
    f"{EVAL} --set n_action_steps=1,4": "Write it in brackets: [1,4]",
    f"{EVAL} --policy=": "--policy: expected a value, found empty text",
    "eval --tasks RememberColor3-v0": "Did you mean '--task'?",
    "eval --model act": "Did you mean '--policy'?",
    "eval --task RememberColor4-v0 --policy oracle": "Did you mean 'RememberColor",
    "record --task RememberColor3-v0 --seed 7": "Did you mean '--seed-start'?",
    "record --task RememberColor3-v0 --set delay_steps=7": "Did you mean 'env.delay_steps'?",
    "probe --task RememberColor3-v0 --policy oracle --set delay_steps=7": "'env.delay_steps'",
    "finetune --policy act --dataset d --seed 1": "Did you mean '--run-seed'?",
    "finetune --policy act --dataset d --checkpoint c": "Did you mean '--base-checkpoint'?",
    "report runs/x --by K": "mikasa-vla compare RUN --by n_action_steps",
    "report runs/x --format tex": "Did you mean 'latex'?",
    "report runs/x --page out": "Did you mean '--html'?",
    "compare runs/x --by K": "Did you mean 'n_action_steps'?",
    "view runs/x --seed-start 3": "Did you mean '--seed'?",
    "list task": "Did you mean 'tasks'?",
}


@pytest.mark.parametrize(("line", "words"), SLIPS.items(), ids=SLIPS)
def test_a_slip_is_answered_with_what_is_meant(
    line: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = main(line.split())
    except SystemExit as exc:  # argparse's
        code = int(exc.code or 0)
    assert code == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("typed", ["1 4 8", "1,4,8", "1, 4, 8", "1 4,8"])
def test_numbers_are_separated_by_blanks_or_commas(typed: str) -> None:
    for line, name in (
        ("eval --n-action-steps", "n_action_steps"),
        ("bench --sessions", "sessions"),
        ("replay data --episodes", "episodes"),
        ("view data --episode", "episode"),
        ("probe --delay", "delays"),
    ):
        args = build_parser((line.split()[0],)).parse_args([*line.split(), *typed.split()])
        assert getattr(args, name) == [1, 4, 8]


def test_a_flag_that_is_given_twice_adds_its_numbers() -> None:
    line = "eval --n-action-steps 1 --n-action-steps 4,8"
    assert build_parser(("eval",)).parse_args(line.split()).n_action_steps == [1, 4, 8]


def test_an_empty_variable_is_called_empty(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*EVAL.split(), "--policy", ""]) == 1
    assert "--policy: expected a value, found empty text" in capsys.readouterr().err
    assert main(["check", ""]) == 1
    assert "found empty text" in capsys.readouterr().err


def test_a_task_without_its_version_is_recorded_by_its_full_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shared = "--policy oracle --episodes 1 --workers 1 --set simulator=fake"
    assert main(f"eval --task RememberColor3 {shared} --out flag".split()) == 0
    Path("own.yaml").write_text("{name: own, tasks: [RememberColor3], policies: [oracle]}")
    assert main(f"eval own.yaml {shared} --out file".split()) == 0
    for run in ("flag", "file"):
        (record,) = map(json.loads, Path(run, "episodes.jsonl").read_text().splitlines())
        assert record["task"] == "RememberColor3-v0"
        assert json.loads(Path(run, "run.json").read_text())["config"]["tasks"] == ["RememberColor3-v0"]
