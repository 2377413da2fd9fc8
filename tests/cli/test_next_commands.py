"""What `record` and `finetune` say last is the command that comes next, and it is accepted as it stands."""

import shlex
from pathlib import Path

import pytest

from vla_eval.checkpoints.files import find_checkpoint, read_facts
from vla_eval.cli import finetune
from vla_eval.cli.main import build_parser, main
from vla_eval.training.request import FinetuneSummary

pytestmark = pytest.mark.usefixtures("in_this_process")
TASK = "RememberColor3-v0"


def next_words(err: str) -> list[str]:
    (line,) = [line for line in err.splitlines() if line.startswith("Next: ")]
    program, *words = shlex.split(line.removeprefix("Next: "))
    assert program == "mikasa-vla"
    build_parser((words[0],)).parse_args(words)
    return words


def test_after_record_the_dataset_is_trained_on_or_first_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    own = ["--task", TASK, "--episodes", "1", "--workers", "1", "--set", "simulator=fake", "--out", "my data"]
    assert main(["record", *own, "--no-replay"]) == 0
    replay = next_words(capfd.readouterr().err)
    assert replay == ["replay", f"my data/{TASK}"]
    assert main(["record", *own]) == 0
    training = next_words(capfd.readouterr().err)
    assert training == ["finetune", "--policy", "act", "--dataset", f"my data/{TASK}"]


def test_after_a_training_its_checkpoint_is_evaluated_on_the_task_of_its_demonstrations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = find_checkpoint(Path("memory_color3"))
    facts = read_facts(shipped)
    assert facts is not None and facts.task == TASK
    run = tmp_path / "my run"
    (run / "train/checkpoints").mkdir(parents=True)
    (run / "train/checkpoints/000010").mkdir()
    (run / "train/checkpoints/000010/pretrained_model").symlink_to(shipped)
    monkeypatch.chdir(tmp_path)

    assert finetune._done(FinetuneSummary(out=Path("my run"), step=10, is_finished=True)) == 0

    evaluation = next_words(capsys.readouterr().err)
    assert evaluation == ["eval", "--task", TASK, "--policy", "my run", "cue_blind", "oracle"]
    assert main([*evaluation, "--dry-run", "--set", "simulator=fake"]) == 0
