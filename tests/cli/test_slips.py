"""What people type for what they mean: each gets a reply that names what is meant, or is understood."""

import argparse
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vla_eval.cli.main import build_parser, main
from vla_eval.errors import did_you_mean
from vla_eval.tasks.catalog import FAMILIES, TASKS

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
    f"{EVAL} --set delay_steps=20": "Did you mean 'env.delay_steps'?",
    f"{EVAL} --set cue_steps=20": "Did you mean 'env.cue_steps'?",
    f"{EVAL} --set horizon_steps=90": "Did you mean 'env.horizon_steps'?",
    f"{EVAL} --set backend=gpu": "Did you mean 'render.backend'?",
    f"{EVAL} --set episdes=5": "Did you mean 'episodes'?",
    f"{EVAL} --set n_action_steps=1,4": "Write it in brackets: [1,4]",
    f"{EVAL} --policy=": "--policy: expected a value, found empty text",
    "eval --tasks RememberColor3-v0": "Did you mean '--task'?",
    "eval --model act": "Did you mean '--policy'?",
    "record --task RememberColor4-v0": "'RememberColor3-v0' or 'RememberColor5-v0' or 'RememberColor9-v0'?",
    "record --task InterceptHard-v0": "'InterceptFast-v0' or 'InterceptMedium-v0' or 'InterceptSlow-v0'?",
    "eval --task RememberColour3-v0 --policy oracle": "Did you mean 'RememberColor3-v0'?",
    "eval --task RememberColor3-v0 --policy memory_color4": "Did you mean 'memory_color3'?",
    "record --task RememberColor3-v0 --seed 7": "Did you mean '--seed-start'?",
    "record --task RememberColor3-v0 --set delay_steps=7": "Did you mean 'env.delay_steps'?",
    "probe --task RememberColor3-v0 --policy oracle --set delay_steps=7": "'env.delay_steps'",
    "finetune --policy act --dataset d --seed 1": "Did you mean '--run-seed'?",
    "finetune --policy act --dataset d --set chunk_size=8": "Did you mean 'policy.chunk_size'?",
    "finetune --policy act --dataset d --set optimizer_lr=1": "Did you mean 'policy.optimizer_lr'?",
    "finetune --policy act --dataset d --set bath_size=8": "Did you mean 'batch_size'?",
    "finetune --policy act --dataset d --checkpoint c": "Did you mean '--base-checkpoint'?",
    "report runs/x --by K": "mikasa-vla compare RUN --by n_action_steps",
    "report runs/x --format tex": "Did you mean 'latex'?",
    "report runs/x --page out": "Did you mean '--html'?",
    "compare runs/x --by K": "Did you mean 'n_action_steps'?",
    "view runs/x --seed-start 3": "Did you mean '--seed'?",
    "list task": "Did you mean 'tasks'?",
}


# What lerobot-eval, lerobot-train and lerobot-record call it, and other programs.
SLIPS |= {
    f"{EVAL} --policy.path=ck": "Did you mean '--policy'?",
    f"{EVAL} --env.type=mikasa": "Did you mean '--task'?",
    f"{EVAL} --env.task=x": "Did you mean '--task'?",
    f"{EVAL} --eval.n_episodes=5": "Did you mean '--episodes'?",
    f"{EVAL} --eval.batch_size=5": "Did you mean '--workers'?",
    f"{EVAL} --batch_size 4": "Did you mean '--workers'?",
    f"{EVAL} --output_dir out": "Did you mean '--out'?",
    f"{EVAL} --policy.n_action_steps=4": "Did you mean '--n-action-steps'?",
    f"{EVAL} --policy.device=cuda": "args: {device: cuda}",
    f"{EVAL} --ckpt x.pt": "Did you mean '--policy'?",
    f"{EVAL} --max-steps 50": "--set env.horizon_steps=90",
    f"{EVAL} --Episodes 5": "Did you mean '--episodes'?",
    "eval --task RememberColor3-v0 --policy lerobot/smolvla_base": "hub:lerobot/smolvla_base@REVISION",
    "finetune --policy.type=act --dataset d": "Did you mean '--policy'?",
    "finetune --policy act --dataset.repo_id=d": "Did you mean '--dataset'?",
    "finetune --policy act --dataset.root=d": "Did you mean '--dataset'?",
    "finetune --policy act --dataset d --batch_size=8": "Did you mean '--batch-size'?",
    "finetune --policy act --dataset d --save_freq 100": "--set save_every_steps=",
    "finetune --policy act --dataset d --wandb.enable=true": "--set wandb_project=NAME",
    "finetune --policy act --dataset d --learning-rate 1": "Learning rates are fields of the recipe.",
    "finetune --policy act --dataset d --epochs 3": "Did you mean '--steps'?",
    "record --task RememberColor3-v0 --dataset.num_episodes=5": "Did you mean '--episodes'?",
    "report runs/x --latex": "Did you mean '--format'?",
    "train --policy act": "Did you mean 'finetune'?",
    "help": "Did you mean '--help'?",
    "version": "Did you mean '--version'?",
    "list envs": "Did you mean 'tasks'?",
}
SLIPS |= {  # a device that does not exist, wherever one is named
    f"{line} {device}": f"expected auto, cpu, {words}"
    for device in ("gpu", "cuda:x", "GPU")
    for line, words in {
        "finetune --policy act --dataset d --device": "cuda",
        "finetune --policy act --dataset d --dry-run --device": "cuda",
        "serve --policy act --device": "cuda",
        "checkpoint verify d --device": "cuda",
        "checkpoint rehearse act --device": "cuda",
    }.items()
} | {
    f"{EVAL} --dry-run --set render.backend=vulkan": "expected auto, cpu, gpu, or a device",
    "record --task RememberColor3-v0 --set render.backend=vulkan": "expected auto, cpu, gpu, or a device",
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


def list_flags(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.Action]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, verb in action.choices.items():
                yield from ((f"{name} {words}".rstrip(), found) for words, found in list_flags(verb))
        elif action.option_strings and action.nargs == "+" and action.help != argparse.SUPPRESS:
            yield "", action


@pytest.mark.parametrize(
    ("verb", "action"),
    list(list_flags(build_parser())),
    ids=lambda of: of if isinstance(of, str) else of.dest,
)
def test_a_flag_with_several_values_is_given_once(
    verb: str, action: argparse.Action, capsys: pytest.CaptureFixture[str]
) -> None:
    flag = action.option_strings[0]
    rest = (
        ["x", "--out", "y"] if verb.startswith("checkpoint") else ["x"] if verb in ("replay", "view") else []
    )
    value = "RememberColor3-v0" if flag == "--task" else "light" if action.type is str else "1"
    once = [*verb.split(), *rest, flag, value]
    build_parser((once[0],)).parse_args([*once, value])  # both after one flag
    with pytest.raises(SystemExit):
        build_parser((once[0],)).parse_args([*once, flag, value])
    assert f"{flag}: is given twice. Name all after one: {flag} A B." in capsys.readouterr().err


@pytest.mark.parametrize(
    "line",
    [
        *(f"{EVAL} {flag}" for flag in ("--yes", "--verbose", "--rename_map={}", "--pretrained=x", "--xyz")),
        *("record --policy oracle", "record --fps 30", "doctor --fix", "check --policy oracle"),
        *("replay d --dataset d", "compare runs/a --metric success", "view --run runs/a"),
    ],
)
def test_no_flag_is_suggested_that_has_only_its_dashes_in_common(
    line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        assert main(line.split()) == 1
    except SystemExit as exc:  # argparse's
        assert exc.code == 1
    assert "Did you mean" not in capsys.readouterr().err


def test_a_word_is_not_taken_for_the_level_of_a_name_that_it_is_all_of() -> None:
    assert did_you_mean("help", ["eval", "report", "merge", "init"]) in ("", " Did you mean 'eval'?")
    found = did_you_mean("RememberColor4-v0", ["RememberColor3-v0", "RememberColor5-v0"])
    assert found == " Did you mean 'RememberColor3-v0' or 'RememberColor5-v0'?"


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


@pytest.mark.parametrize("task", [one for one in TASKS if re.search(r"\d-v0", one)])
@pytest.mark.parametrize("case", [str, str.lower])
def test_a_number_that_no_task_has_is_answered_with_those_of_its_family(
    task: str, case: Callable[[str], str]
) -> None:
    family = re.sub(r"[\dx]+-v0$", "", task)
    levels = sorted(one for one in TASKS if re.fullmatch(rf"{family}[\dx]+-v0", one))
    meant = did_you_mean(case(re.sub(r"[\dx]+-v0$", "8-v0", task)), [*TASKS, *FAMILIES])
    assert sorted(re.findall(r"'(.+?)'", meant)) == levels
