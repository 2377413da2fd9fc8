"""What a run notes of a policy's weights: their digests, and by which statistics they normalise."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from tests.evaluation.resolved import make_plan
from vla_eval.checkpoints.files import TrainingFacts, write_facts
from vla_eval.checkpoints.notes import normalization_notes
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.data.recording.plan import plan_recording
from vla_eval.errors import CheckpointError, TaskArgumentError
from vla_eval.evaluation.plan import Plan
from vla_eval.seeding import SeedRange
from vla_eval.storage.run_file import RunDescription, RunFile, Session
from vla_eval.strict.decoding import decode

IMAGES = "observation.images.base"
STATE = {"mean": [1, 2], "std": [3, 4], "q01": [9, 9]}


def processor(*steps: dict[str, Any]) -> str:
    return json.dumps({"name": "p", "steps": list(steps)})


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """Lerobot's normaliser before the policy, ours after it."""
    folder = tmp_path / "weights"
    folder.mkdir()
    (folder / "config.json").write_text('{"type": "x", "n_action_steps": 4}')
    save_file({"w": np.ones(2, np.float32)}, folder / "model.safetensors")
    kinds = {"observation.state": "STATE", IMAGES: "VISUAL", "action": "ACTION"}
    features = {name: {"type": kind} for name, kind in kinds.items()}
    norm_map = {"STATE": "MEAN_STD", "VISUAL": "IDENTITY", "ACTION": "MIN_MAX"}
    lerobots = {
        "registry_name": "normalizer_processor",
        "config": {"features": features, "norm_map": norm_map},
        "state_file": "before.safetensors",
    }
    ours = {
        "registry_name": "mikasa_decoder",
        "config": {"fields": {"action": {"kind": "q01_q99", "mask": [True, False]}}},
        "state_file": "after.safetensors",
    }
    (folder / "policy_preprocessor.json").write_text(
        processor({"registry_name": "device_processor", "config": {}}, lerobots)
    )
    (folder / "policy_postprocessor.json").write_text(processor(ours))
    before = {
        **{f"observation.state.{name}": values for name, values in STATE.items()},
        **{"action.min": [-1, -2], "action.max": [1, 2], f"{IMAGES}.mean": [0.5]},
    }
    save_file({k: np.array(v, np.float32) for k, v in before.items()}, folder / "before.safetensors")
    after = {"action/q01": [-0.5, 0], "action/q99": [0.5, 1]}
    save_file({k: np.array(v, np.float32) for k, v in after.items()}, folder / "after.safetensors")
    return folder


def plan(tmp_path: Path, adapter: str, checkpoint: Path) -> Plan:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text(
        f'version: 1\ndescription: "d"\nadapter: {adapter}\nargs: {{checkpoint: {checkpoint}}}\n'
        "default_n_action_steps: 1\n"
    )
    return make_plan(EvalConfig(name="x", tasks=("RememberColor3-v0",), policies=(str(recipe),), episodes=1))


@pytest.mark.parametrize("adapter", ["lerobot", "openvla"])
def test_other_weights_are_another_run_whichever_adapter_reads_them(
    tmp_path: Path, checkpoint: Path, adapter: str
) -> None:
    before = plan(tmp_path, adapter, checkpoint).recipe_hashes
    save_file({"w": np.zeros(2, np.float32)}, checkpoint / "model.safetensors")
    after = plan(tmp_path, adapter, checkpoint).recipe_hashes
    assert {name for name in before if before[name] != after[name]} == {"checkpoints/mine"}


def test_a_run_says_by_which_statistics_its_policies_normalise(tmp_path: Path, checkpoint: Path) -> None:
    expected = {
        "of": "the checkpoint",
        # Pictures are left as they are, and the state's quantiles are there but not used.
        "before": {
            "observation.state": {"mean": [1.0, 2.0], "std": [3.0, 4.0]},
            "action": {"min": [-1.0, -2.0], "max": [1.0, 2.0]},
        },
        "after": {"action": {"q01": [-0.5, 0.0], "q99": [0.5, 1.0]}},
    }
    assert plan(tmp_path, "lerobot", checkpoint).normalization == {"mine": expected}

    facts = TrainingFacts(
        run="r", dataset="mine_250", dataset_sha256="0" * 64, task="RememberColor3-v0", state="eef",
        images={IMAGES: (128, 128)}, fps=20.0, action_names=("x", "y"), control_mode="c", run_seed=0,
    )  # fmt: skip
    write_facts(checkpoint, facts)
    assert normalization_notes("openvla", {"checkpoint": str(checkpoint)}) == {**expected, "of": "mine_250"}
    assert normalization_notes("oracle", {}) == {}


def facts_with(seeds: dict[str, tuple[SeedRange, ...]] | None) -> TrainingFacts:
    return TrainingFacts(
        run="r", dataset="mine_250", dataset_sha256="0" * 64, task="RememberColor3-v0", state="eef",
        images={IMAGES: (128, 128)}, fps=20.0, action_names=("x", "y"), control_mode="c", run_seed=0,
        seeds=seeds,
    )  # fmt: skip


def test_an_evaluation_on_seeds_of_the_demonstrations_is_warned_of(checkpoint: Path, tmp_path: Path) -> None:
    write_facts(checkpoint, facts_with({"RememberColor3-v0": (SeedRange(first=0, last=50),)}))
    (warning,) = plan(tmp_path, "lerobot", checkpoint).warnings  # of seed 1
    assert "mine was trained on demonstrations of 1 of the 1 seeds" in warning
    assert "RememberColor3-v0 (1)" in warning and "--seed-start" in warning


@pytest.mark.parametrize(
    "seeds", [None, {"RememberColor3-v0": (SeedRange(first=5000, last=6000),)}, {"RememberColor5-v0": ()}]
)
def test_other_seeds_other_tasks_and_old_checkpoints_bring_no_warning(
    checkpoint: Path, tmp_path: Path, seeds: dict[str, tuple[SeedRange, ...]] | None
) -> None:
    write_facts(checkpoint, facts_with(seeds))
    assert plan(tmp_path, "lerobot", checkpoint).warnings == []


def test_a_statistic_that_is_used_and_not_there_is_an_error(checkpoint: Path) -> None:
    save_file({"action/q01": np.zeros(2, np.float32)}, checkpoint / "after.safetensors")
    with pytest.raises(CheckpointError, match=r"after\.safetensors: has no statistic 'q99' of 'action'"):
        normalization_notes("lerobot", {"checkpoint": str(checkpoint)})
    (checkpoint / "after.safetensors").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match=r"after\.safetensors: cannot be read as safetensors"):
        normalization_notes("lerobot", {"checkpoint": str(checkpoint)})
    (checkpoint / "after.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"after\.safetensors: there is no such file"):
        normalization_notes("lerobot", {"checkpoint": str(checkpoint)})


def test_a_kind_of_normalisation_that_is_not_known_is_an_error(checkpoint: Path) -> None:
    file = checkpoint / "policy_postprocessor.json"
    file.write_text(file.read_text().replace("q01_q99", "min_max"))
    with pytest.raises(
        CheckpointError, match=r"mikasa_decoder normalises 'action' by 'min_max', known are m"
    ):
        normalization_notes("lerobot", {"checkpoint": str(checkpoint)})


def test_a_run_of_a_version_that_did_not_note_them_can_be_read(tmp_path: Path) -> None:
    described = RunDescription(
        name="a",
        config={},
        recipes={},
        environment={},
        options={},
        command="",
        normalization={"p": {"of": "d"}},
        training_seeds={"p": {"RememberColor3-v0": (SeedRange(first=1, last=3),)}},
    )
    session = Session(started_at="2026-01-01T00:00:00+00:00", command="", options={})
    RunFile(description=described, sessions=(session,)).save(tmp_path)
    assert RunFile.load(tmp_path).description == described
    data = json.loads((tmp_path / "run.json").read_text())
    del data["normalization"], data["training_seeds"]
    (tmp_path / "run.json").write_text(json.dumps(data))
    assert RunFile.load(tmp_path).description.normalization == {}


def test_a_recording_refuses_arguments_that_the_task_cannot_have_before_anything_starts() -> None:
    def recipe(task: str, **env: Any) -> DatasetRecipe:
        return decode(DatasetRecipe, {"name": "d", "tasks": [task], "env": env}, where="test")

    with pytest.raises(TaskArgumentError, match=r"RememberColor is a family.*--set env\.n_items"):
        plan_recording(recipe("RememberColor"))
    with pytest.raises(TaskArgumentError, match=r"env\.show_cue: TakeItBack-v0: there are no candidates"):
        plan_recording(recipe("TakeItBack-v0", show_cue=False))
    assert plan_recording(recipe("RememberColor", n_items=4)).tasks


@pytest.mark.parametrize("name", ["memory_color3", "memoryless_color3"])
def test_shipped_weights_are_normalised_by_no_statistic_so_that_no_rule_on_them_moves_their_actions(
    name: str,
) -> None:
    notes = normalization_notes("lerobot", {"checkpoint": name})

    assert notes["before"] == notes["after"] == {}
