"""A training that is asked to stop: Ctrl-C, a time limit of a cluster."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from safetensors import SafetensorError

from tests.training import tiny_trainings
from tests.training.test_held_out import metrics, same_weights
from tests.training.tiny_trainings import SHORT, TINY_ACT, act
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.cli.main import main
from vla_eval.errors import StorageFullError
from vla_eval.training import loop
from vla_eval.training.finetune import finetune

pytestmark = pytest.mark.usefixtures("small_act")
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own


def after(n_steps: int) -> Callable[[], bool]:
    """Say yes when so many steps are done: the question is asked before each step."""
    asked = iter(range(n_steps))
    return lambda: next(asked, None) is None


def checkpoints(run: Path) -> list[str]:
    return sorted(entry.name for entry in (run / "train/checkpoints").iterdir())


def test_a_training_that_was_stopped_ends_with_the_very_weights_of_one_that_was_not(
    recorded: Path, tmp_path: Path
) -> None:
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    assert finetune(act(recorded, straight)).is_finished

    first = finetune(act(recorded, stopped), is_stopping=after(3))
    assert (first.is_finished, first.step) == (False, 3)
    assert checkpoints(stopped) == ["000002", "000003", "last"]
    assert first.checkpoint.resolve().parent.name == "000003"
    again = finetune(act(recorded, stopped))

    assert (again.is_finished, again.step) == (True, 4)
    assert same_weights(straight, stopped)
    assert metrics(stopped) == metrics(straight)
    assert checkpoints(stopped) == ["000002", "000004", "last"]  # the extra one has served its purpose


def test_a_full_disk_is_named_and_the_same_command_resumes(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the first checkpoint the configuration fits, the weights do not."""
    straight, run = tmp_path / "straight", tmp_path / "run"

    def save(*_: Any, **__: Any) -> None:
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    with monkeypatch.context() as full:
        full.setattr("safetensors.torch.save_file", save)
        with pytest.raises(StorageFullError, match=r"run: could not be written .*run the same command again"):
            finetune(act(recorded, run))
    assert finetune(act(recorded, straight)).is_finished and finetune(act(recorded, run)).is_finished
    assert same_weights(straight, run)


def test_nothing_is_written_twice_and_nothing_before_the_first_step(recorded: Path, tmp_path: Path) -> None:
    for n_steps, found in ((0, []), (2, ["000002", "last"])):
        run = tmp_path / f"run-{n_steps}"
        summary = finetune(act(recorded, run), is_stopping=after(n_steps))
        assert (summary.is_finished, summary.step) == (False, n_steps)
        assert (checkpoints(run) if n_steps else []) == found
    again = finetune(act(recorded, tmp_path / "run-0"))  # it begins
    assert again.is_finished


def test_processes_that_load_samples_outlive_ctrl_c(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a terminal it reaches every process; the training needs the samples until it has stopped."""
    interrupted: list[int] = []

    def interrupt(run_seed: int, step: int, process: int, original: Any = loop.seed_step) -> None:
        for child in multiprocessing.active_children():
            assert child.pid is not None
            os.kill(child.pid, signal.SIGINT)
            interrupted.append(step)
        original(run_seed, step, process)

    monkeypatch.setattr(loop, "seed_step", interrupt)
    # A forked process gets the signal as ours do, which import torch and lerobot first.
    monkeypatch.setattr(loop, "child_context", lambda: multiprocessing.get_context("fork"))
    assert finetune(act(recorded, tmp_path / "run", num_workers=1)).is_finished
    assert set(interrupted) >= {0, 1, 2}


@pytest.fixture
def signals_as_on_a_terminal() -> Iterator[None]:
    """A process that a script has started in the background ignores Ctrl-C, and so do we."""
    before = [(number, signal.signal(number, signal.SIG_DFL)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    for number, handler in before:
        signal.signal(number, handler)


@pytest.mark.usefixtures("signals_as_on_a_terminal")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_stops_the_command_with_a_checkpoint_and_the_same_command_resumes(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    number: signal.Signals,
    code: int,
) -> None:
    run = tmp_path / "run"
    command = ["finetune", "--policy", "act", "--dataset", str(recorded), "--out", str(run)]
    command += ["--device", "cpu", "--allow-unreplayed"]
    fields = {**SHORT, "save_every_steps": 4, **{f"policy.{key}": value for key, value in TINY_ACT.items()}}
    for name, value in fields.items():
        command += ["--set", f"{name}={value}"]

    def send(run_seed: int, step: int, process: int, original: Any = loop.seed_step) -> None:
        if step == 1:
            signal.raise_signal(number)
        original(run_seed, step, process)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "seed_step", send)
        assert main(command) == code
    screen = capfd.readouterr()
    assert screen.out == ""
    assert "Stopping after this step, with a checkpoint. Once more: at once, without one." in screen.err
    assert f"Stopped at step 2 in {run}. To resume: " in screen.err
    assert checkpoints(run) == ["000002", "last"]

    assert main(command) == 0
    screen = capfd.readouterr()
    assert "resuming from step 2" in screen.err
    assert screen.out.strip() == str(find_checkpoint(run))
    assert checkpoints(run) == ["000004", "last"]
