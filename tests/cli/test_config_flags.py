"""Flags on top of a file: whatever the file holds, the result is a configuration or one message."""

import os
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.main import build_parser, main
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.errors import RecipeError
from vla_eval.strict.decoding import decode

EVAL = "name: x\ntasks: [RememberColor3-v0]\npolicies: [random]\n"
FINETUNE = "policy: act\ndataset: d\n"


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one message of a command that is refused."""
    assert main(arguments) == 1
    captured = capsys.readouterr()
    assert not captured.out
    assert captured.err.startswith("mikasa-vla: error: ")
    assert "Traceback" not in captured.err
    return captured.err


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("verb", "text", "flags", "message"),
    [
        (
            "eval",
            EVAL + "capture: none\n",
            ["--capture-video", "all"],
            "'capture' is 'none', which has no",
        ),
        ("eval", EVAL + "chunking: 3\n", ["--set", "chunking.mode=stale"], "'chunking' is 3, which has no"),
        ("eval", EVAL, ["--set", "tasks.x=1"], "'tasks' is a list"),
        ("eval", EVAL, ["--set", "a..b=1"], "expected FIELD=VALUE"),
        ("eval", EVAL, ["--set", "env.=1"], "expected FIELD=VALUE"),
        ("eval", EVAL, ["--set", "env" + ".a" * 3000 + "=1"], "nested more than 50 deep"),
        ("eval", EVAL, ["--set", "episodes=" + "9" * 5000], "5000 digits"),
        ("eval", EVAL, ["--set", "env.a=" + "[" * 3000], "nested more than 50 deep"),
        ("eval", EVAL, ["--set", "env.x=.nan"], "expected a finite number, found nan"),
        ("eval", EVAL, ["--set", "chunking.ensemble_decay=.inf"], "expected a finite number, found inf"),
        ("eval", EVAL, ["--set", "x" * 500 + "=1"], "there is no field"),
        ("eval", EVAL, ["--episodes", "100000000"], "episodes is 100000000"),
        ("eval", EVAL, ["--seed-start", "4294967296"], "the largest seed"),
        ("eval", EVAL, ["--seed-start", "-1"], "seed_start is -1"),
        ("finetune", FINETUNE + "held_out: 5\n", ["--held-out-every", "2"], "'held_out' is 5, which has no"),
        ("finetune", FINETUNE + "finetune: 5\n", ["--steps", "2"], "'finetune' is 5, which has no"),
        ("finetune", FINETUNE + "finetune: 5\n", ["--set", "steps=2"], "'finetune': expected a mapping"),
        ("finetune", FINETUNE, ["--run-seed", "4294967296"], "run_seed is 4294967296"),
        ("record", "name: d\ntasks: [RememberColor3-v0]\n", ["--seed-start", "4294967200"], "largest seed"),
    ],
)
def test_a_mistake_in_file_or_flag_is_one_message(
    folder: Path, capsys: pytest.CaptureFixture[str], verb: str, text: str, flags: list[str], message: str
) -> None:
    (folder / "own.yaml").write_text(text)

    error = fails([verb, "own.yaml", *flags], capsys)

    assert message in error
    assert len(error) < 1500
    assert [path.name for path in folder.iterdir()] == ["own.yaml"]


def test_a_field_without_a_value_takes_what_a_flag_says(folder: Path) -> None:
    data = {"name": "x", "tasks": ["a"], "policies": ["b"], "capture": None}

    apply_overrides(data, ["capture.video=all"], cls=EvalConfig)

    assert decode(EvalConfig, data, where="x").capture.video == "all"


def test_fields_of_an_optional_part_can_be_set() -> None:
    data = {"type": "act", "base_checkpoint": "b", "lora": None}

    apply_overrides(data, ["lora.rank=8", "image_transforms.tfs.a.weight=2.0"], cls=FinetuneRecipe)

    recipe = decode(FinetuneRecipe, data, where="x")
    assert recipe.lora is not None
    assert recipe.lora.rank == 8
    assert recipe.image_transforms == {"tfs": {"a": {"weight": 2.0}}}


@pytest.mark.parametrize(
    ("cls", "data", "message"),
    [
        (FinetuneRecipe, {"type": "act", "steps": 10**12}, r"finetune\.steps is 1000000000000"),
        (FinetuneRecipe, {"type": "act", "num_workers": 10**6}, r"finetune\.num_workers is 1000000"),
        (
            FinetuneRecipe,
            {"type": "act", "base_checkpoint": "b", "lora": {"rank": 0}},
            r"finetune\.lora\.rank is 0",
        ),
        (FinetuneConfig, {"policy": "p", "dataset": "d", "run_seed": -1}, "run_seed is -1"),
        (
            FinetuneConfig,
            {"policy": "p", "dataset": "d", "held_out": {"every_steps": 1, "seed_start": 2**32}},
            r"held_out\.seed_start is 4294967296",
        ),
        (DatasetRecipe, {"name": "d", "tasks": ["t"], "encoder": {"crf": 1000}}, "crf is 1000"),
        (DatasetRecipe, {"name": "d", "tasks": ["t"], "episodes": 10**9}, "episodes is 1000000000"),
        (DatasetRecipe, {"name": "d", "tasks": ["t"], "action_noise": 1e9}, "action_noise is 1000000000.0"),
    ],
)
def test_a_number_out_of_bounds_is_refused(cls: type, data: dict[str, object], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        decode(cls, data, where="x")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--episodes", "0"], "episodes is 0"),
        (["--episodes", "10000000"], "episodes is 10000000"),
        (["--workers", "0"], "workers is 0"),
        (["--set", "seed_start=4294967295"], "the largest seed"),
        (["--task", "RememberColour3-v0"], "Did you mean"),
    ],
)
def test_an_audit_is_refused_before_it_starts(
    folder: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    assert message in fails(["audit", *flags], capsys)
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--repeats", "0"], "repeats is 0"),
        (["--repeats", "1000000000"], "repeats is 1000000000"),
        (["--n-action-steps", "0"], "n_action_steps is 0"),
        (["--loader", "--batches", "0"], "batches is 0"),
        (["--loader", "--repeats", "0"], "repeats is 0"),
        (["--serve", "--sessions", "1", "0"], "sessions is 0"),
        (["--serve", "--seconds", "0"], "seconds is 0"),
    ],
)
def test_a_bench_is_refused_before_it_starts(
    capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    assert message in fails(["bench", *flags], capsys)


def test_a_bench_takes_what_it_takes_by_default() -> None:
    args = build_parser(("bench",)).parse_args(["bench"])

    assert (args.repeats, args.batches, args.n_action_steps) == (2, 4, [1, 4, 8])


@pytest.mark.parametrize(
    "command",
    [
        "eval --task RememberColor3-v0 --policy oracle --dry-run",
        "finetune --policy act --dataset nowhere --dry-run",
        "finetune --policy act --dataset {recorded}",
    ],
)
def test_a_folder_that_may_not_be_changed_is_refused_before_work_begins(
    command: str,
    folder: Path,
    recorded: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = os.access
    closed = str(folder)

    def access(path: Any, mode: int) -> bool:  # a test may run as a user who may do anything
        return str(path) != closed and asked(path, mode)

    monkeypatch.setattr("vla_eval.storage.folders.os.access", access)
    words = command.format(recorded=recorded).split()

    assert f"this user has no permission for {folder}" in fails([*words, "--out", str(folder / "x")], capsys)
    assert not (folder / "x").exists()
