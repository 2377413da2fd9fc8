"""Episodes without success: who imitates leaves them out, and it is said and recorded."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.data.failed_episodes import let_fail
from tests.training import tiny_trainings
from tests.training.tiny_trainings import act
from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.errors import DatasetError, RecipeError, TrainingError
from vla_eval.training.dataset import training_dataset
from vla_eval.training.finetune import finetune
from vla_eval.training.job import training_job

pytestmark = pytest.mark.usefixtures("small_act")
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own


def test_a_dataset_knows_its_failures(recorded: Path) -> None:
    assert training_dataset(recorded, allow_unreplayed=True).failed == ()
    let_fail(recorded, 0, 2)
    assert training_dataset(recorded, allow_unreplayed=True).failed == (0, 2)


def test_imitation_never_sees_them(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    let_fail(recorded, 1, 2)
    served, seen = DecodedFramesDataset.__getitem__, set()

    def watched(dataset: DecodedFramesDataset, index: int) -> dict[str, torch.Tensor]:
        sample = served(dataset, index)
        seen.add(int(sample["episode_index"]))
        return sample

    monkeypatch.setattr(DecodedFramesDataset, "__getitem__", watched)
    monkeypatch.delattr(DecodedFramesDataset, "__getitems__", raising=False)
    lines: list[str] = []
    # 26 frames are left: 4 steps of 13 show each at least once.
    finetune(act(recorded, tmp_path / "run", batch_size=13), say=lines.append)
    assert seen == {0, 3}
    assert "failed episodes: 2 of 4, left out" in lines
    assert any("26 of 26 frames" in line for line in lines)
    settings = json.loads((tmp_path / "run" / "finetune.json").read_text())["settings"]
    assert settings["dataset"]["episodes_left_out"] == [1, 2]
    assert "failed_episodes" not in settings["finetune"]  # runs of earlier versions resume


def test_a_recipe_may_keep_them(recorded: Path, tmp_path: Path) -> None:
    let_fail(recorded, 1)
    kept = training_job(act(recorded, tmp_path / "o", failed_episodes="keep"))
    assert (kept.dataset.left_out, kept.dataset.episodes) == ((), None)
    assert kept.frames == (55, 55)
    left_out = training_job(act(recorded, tmp_path / "o"))
    assert left_out.dataset.episodes == [0, 2, 3]
    assert left_out.frames == (41, 41)  # 13 + 15 + 13


def test_a_dataset_of_failures_alone_is_refused(recorded: Path, tmp_path: Path) -> None:
    let_fail(recorded, 0, 1, 2, 3)
    with pytest.raises(DatasetError, match=r"expected episodes to imitate, found none"):
        training_job(act(recorded, tmp_path / "o"))


def test_a_run_does_not_resume_with_other_episodes(recorded: Path, tmp_path: Path) -> None:
    let_fail(recorded, 1)
    finetune(act(recorded, tmp_path / "run", steps=2))
    with pytest.raises(TrainingError, match="episodes_left_out"):
        finetune(act(recorded, tmp_path / "run", steps=2, failed_episodes="keep"))


def test_another_word_is_answered_by_the_two(recorded: Path, tmp_path: Path) -> None:
    config = act(recorded, tmp_path / "o")
    with pytest.raises(RecipeError, match=r"failed_episodes.*keep.*leave_out"):
        training_job(replace(config, finetune={**config.finetune, "failed_episodes": "drop"}))
