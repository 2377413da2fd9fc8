"""A folder in place of a recipe gets an answer that says what it is and how to go on from it."""

import json
from pathlib import Path

import pytest

from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.data.manifest import RECORDING_FILE
from vla_eval.errors import DatasetError, RecipeError
from vla_eval.testing.synthetic import write_synthetic_dataset
from vla_eval.training.request import load_finetune_recipe, look_for

COMMAND = "mikasa-vla finetune --policy act --dataset data --steps 100 --out 'my runs/rec'"


def asked(policy: Path, dataset: str = "data") -> FinetuneConfig:
    return FinetuneConfig(policy=str(policy), dataset=dataset)


def test_a_run_in_place_of_a_recipe_is_named_with_how_to_continue_and_start_from_it(tmp_path: Path) -> None:
    run = tmp_path / "my runs" / "rec"
    run.mkdir(parents=True)
    (run / "finetune.json").write_text(
        json.dumps({"format_version": 1, "policy": "act", "command": COMMAND, "settings": {}})
    )

    with pytest.raises(RecipeError) as refused:
        load_finetune_recipe(asked(run))

    message = str(refused.value)
    assert f"{run}: is a run of policy 'act', not a recipe" in message
    assert "more --steps" in message and COMMAND in message
    assert f"--policy act --base-checkpoint '{run}'" in message  # quoted: its path has a blank


def test_a_checkpoint_in_place_of_a_recipe_is_one_to_start_from(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(RecipeError, match=rf"is a checkpoint, .*--base-checkpoint {tmp_path}$"):
        load_finetune_recipe(asked(tmp_path))


def test_another_folder_in_place_of_a_recipe_is_no_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="is a folder without a checkpoint, not a recipe"):
        load_finetune_recipe(asked(tmp_path))


def test_a_recipe_hides_a_folder_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "act").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_finetune_recipe(asked(Path("act"))).name == "act"


def test_a_dataset_levels_below_is_named_and_is_no_recording_that_resumes(tmp_path: Path) -> None:
    dataset = tmp_path / "data" / "demonstrations" / "RememberColor3-v0"
    write_synthetic_dataset(dataset, n_episodes=1, n_frames=2)

    with pytest.raises(DatasetError) as refused:
        look_for(asked(Path("act"), str(tmp_path / "data")))

    assert f"Below it are datasets: {dataset}." in str(refused.value)
    assert "resumes" not in str(refused.value)


def test_a_dataset_of_another_program_is_no_recording_that_resumes(tmp_path: Path) -> None:
    root = write_synthetic_dataset(tmp_path / "foreign", n_episodes=1, n_frames=2)
    with pytest.raises(DatasetError, match="mikasa-vla dataset check") as refused:
        look_for(asked(Path("act"), str(root)))
    assert "resumes" not in str(refused.value)


def test_a_recording_that_was_stopped_resumes(recorded: Path) -> None:
    (recorded / RECORDING_FILE).unlink()
    with pytest.raises(DatasetError, match="a recording resumes"):
        look_for(asked(Path("act"), str(recorded)))
