"""Checkpoints of LeRobot before its processors, and checkpoints that lack files of them: what is said."""

import ast
import inspect
import runpy
import shlex
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from huggingface_hub import ModelCard
from lerobot.processor import migrate_policy_normalization
from safetensors.torch import load_file, save_file

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import copied
from tests.evaluation.resolved import make_plan
from vla_eval.checkpoints.files import POSTPROCESSOR_FILE, PREPROCESSOR_FILE, WEIGHTS_FILE
from vla_eval.checkpoints.loading import LoadOptions, load_checkpoint
from vla_eval.checkpoints.saved_processor import BUILT_IN, refuse_built_in_normalization
from vla_eval.checkpoints.verify import random_batch, verify_checkpoint
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import CheckpointError

pytestmark = pytest.mark.usefixtures("no_network")
backbone, env, act = small_checkpoints.backbone, small_checkpoints.env, small_checkpoints.act
CPU = LoadOptions(device="cpu")


def plan(folder: Path) -> None:
    make_plan(EvalConfig(name="e", tasks=("RememberColor3-v0",), policies=(str(folder),), simulator="fake"))


def as_before_processors(source: Path, target: Path) -> Path:
    """Return a copy with the statistics among the weights, by the names of then, and no processors."""
    target.mkdir()
    folder = copied(source, target)
    tensors = load_file(folder / WEIGHTS_FILE)
    (saved,) = folder.glob("policy_preprocessor*.safetensors")
    for name, values in load_file(saved).items():
        field, _, statistic = name.rpartition(".")
        if statistic not in ("mean", "std"):
            continue
        layer = "unnormalize_outputs" if field == "action" else "normalize_inputs"
        tensors[f"{layer}.buffer_{field.replace('.', '_')}.{statistic}"] = values.clone()
    save_file(tensors, folder / WEIGHTS_FILE)
    for file in folder.glob("policy_*processor*"):
        file.unlink()
    return folder


def lerobots_patterns() -> list[str]:
    """Return the beginnings of names that LeRobot's command looks for, from its code."""
    code = ast.parse(
        textwrap.dedent(inspect.getsource(migrate_policy_normalization.extract_normalization_stats))
    )
    (found,) = (
        node.value
        for node in ast.walk(code)
        if isinstance(node, ast.Assign) and "patterns" in ast.dump(node.targets[0])
    )
    return [str(pattern) for pattern in ast.literal_eval(found)]


def refusals(folder: Path) -> list[str]:
    """Return what each door says that a checkpoint goes through; all must refuse it."""
    messages = []
    for door in (plan, lambda path: verify_checkpoint(path, CPU), lambda path: load_checkpoint(path, CPU)):
        with pytest.raises(CheckpointError) as raised:
            door(folder)
        messages.append(str(raised.value))
    return messages


class TestNormalisationAmongTheWeights:
    def test_each_door_names_lerobots_command(self, act: Path, tmp_path: Path) -> None:
        folder = as_before_processors(act, tmp_path / "old one")
        named = f"migrate_policy_normalization --pretrained-path {shlex.quote(str(folder))} --output-dir NEW"

        for message in refusals(folder):
            assert named in message and "before its processors" in message

    def test_that_command_makes_a_checkpoint_with_the_actions_of_the_original(
        self, act: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder, made = as_before_processors(act, tmp_path / "old"), tmp_path / "new"
        with pytest.raises(CheckpointError) as raised:
            load_checkpoint(folder, CPU)
        command = str(raised.value).rpartition("python -m ")[2].replace("NEW", str(made))
        module, *arguments = shlex.split(command)
        monkeypatch.setattr(sys, "argv", [module, *arguments])
        monkeypatch.setattr(ModelCard, "validate", lambda *_args, **_kwargs: None)  # asks the Hub

        runpy.run_module(module, run_name="__main__")

        actions = []
        for loaded in (load_checkpoint(act, CPU), load_checkpoint(made, CPU)):
            batch = random_batch(loaded.config, (), torch.Generator().manual_seed(0))
            with torch.no_grad():
                chunk = loaded.policy.predict_action_chunk(loaded.preprocessor(batch))
            actions.append(loaded.postprocessor(chunk).numpy())
        assert np.allclose(*actions, atol=1e-6)

    @pytest.mark.parametrize("pattern", lerobots_patterns())
    def test_each_name_that_lerobots_command_looks_for_is_recognised(
        self, pattern: str, tmp_path: Path
    ) -> None:
        assert pattern.startswith(BUILT_IN)
        save_file({f"{pattern}observation_state.mean": torch.zeros(1)}, tmp_path / WEIGHTS_FILE)

        with pytest.raises(CheckpointError, match="before its processors"):
            refuse_built_in_normalization(tmp_path)

    def test_layers_of_a_network_that_begin_like_them_are_not_taken_for_them(self, tmp_path: Path) -> None:
        names = ("normalize.weight", "model.normalize_inputs.mean", "normalizer.mean")
        save_file({name: torch.zeros(1) for name in names}, tmp_path / WEIGHTS_FILE)

        refuse_built_in_normalization(tmp_path)


class TestMissingFiles:
    @pytest.mark.parametrize(
        "name", [PREPROCESSOR_FILE, POSTPROCESSOR_FILE, "*pre*.safetensors", "*post*.safetensors"]
    )
    def test_it_is_named_with_where_it_comes_from(self, act: Path, tmp_path: Path, name: str) -> None:
        folder = copied(act, tmp_path)
        (missing,) = folder.glob(name)
        missing.unlink()

        for message in refusals(folder):
            assert message.startswith(f"{missing}: there is no such file")
            assert "pretrained_model" in message and "hf download" in message
