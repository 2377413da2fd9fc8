"""The scale of the loss in float16 is part of a checkpoint."""

import json
from pathlib import Path

import pytest
import torch

from tests.training import tiny_trainings
from tests.training.test_held_out import same_weights
from tests.training.test_stopping import after
from tests.training.tiny_trainings import act
from vla_eval.errors import TrainingError
from vla_eval.training.checkpoints import load_loss_scale
from vla_eval.training.finetune import finetune

pytestmark = pytest.mark.usefixtures("small_act")
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own
FIRST_SCALE = 2.0**16  # torch.GradScaler's
SCALE = "train/checkpoints/last/training_state/loss_scale.json"


@pytest.fixture
def in_float16(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", "fp16")


@pytest.mark.usefixtures("in_float16")
def test_a_training_in_float16_that_was_stopped_ends_with_the_very_weights_of_one_that_was_not(
    recorded: Path, tmp_path: Path
) -> None:
    """The gradients of the first steps overflow, so that these are left out and the scale is halved."""
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    assert finetune(act(recorded, straight, steps=8)).is_finished
    assert not finetune(act(recorded, stopped, steps=8), is_stopping=after(6)).is_finished
    assert scale_of(stopped) < FIRST_SCALE
    assert finetune(act(recorded, stopped, steps=8)).is_finished
    assert scale_of(stopped) == scale_of(straight)
    assert same_weights(straight, stopped)


@pytest.mark.usefixtures("in_float16")
def test_a_checkpoint_without_that_scale_is_refused(recorded: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    finetune(act(recorded, run), is_stopping=after(2))
    (run / SCALE).unlink()
    with pytest.raises(TrainingError, match=r"loss_scale\.json: is missing"):
        finetune(act(recorded, run))


@pytest.mark.parametrize("damage", ["{}", '{"scale": "much"}', "1.0", ""])
def test_a_damaged_scale_is_refused(tmp_path: Path, damage: str) -> None:
    scaler = torch.GradScaler("cpu")
    (tmp_path / "training_state").mkdir()
    (tmp_path / "training_state/loss_scale.json").write_text(damage)
    with pytest.raises(TrainingError, match="expected the scale of a loss, found"):
        load_loss_scale(tmp_path, scaler)


def test_other_precisions_have_no_scale(recorded: Path, tmp_path: Path) -> None:
    finetune(act(recorded, tmp_path / "run"), is_stopping=after(2))
    assert not (tmp_path / "run" / SCALE).exists()


def scale_of(run: Path) -> float:
    scale: float = json.loads((run / SCALE).read_text())["scale"]
    return scale
