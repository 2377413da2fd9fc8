"""Checkpoints of LeRobot: nothing loads half or runs code, and each folder of one is the same policy."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from safetensors.torch import load_file, save_file

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import FACTS, TASK, context_for, copied
from tests.evaluation.resolved import plan_shard
from vla_eval.checkpoints import loading as lerobot_loading
from vla_eval.checkpoints.files import checkpoint_name, checkpoint_sha256, find_checkpoint, write_facts
from vla_eval.checkpoints.loading import (
    LoadOptions,
    config_class,
    load_weights,
    make_empty_policy,
    read_config,
)
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import CheckpointError
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.models.families import FAMILIES
from vla_eval.models.family import LEROBOT
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import EnvSpec
from vla_eval.storage.run_folder import read_run
from vla_eval.testing.tiny_models import TINY_RUNNER, make_tiny, tiny_paligemma

pytestmark = pytest.mark.usefixtures("no_network")
backbone, env = small_checkpoints.backbone, small_checkpoints.env
act, pi0, make = small_checkpoints.act, small_checkpoints.pi0, small_checkpoints.make


class TestStrictLoading:
    @pytest.fixture
    def broken(self, request: pytest.FixtureRequest, make: Any, tmp_path: Path) -> Callable[..., Any]:
        """Return a function that edits a copy of the checkpoint's tensors and loads it."""
        name = request.node.callspec.params["make"]
        source: Path = request.getfixturevalue(name)

        def load(edit: Callable[[dict[str, torch.Tensor]], None]) -> LeRobotPolicy:
            for file in source.iterdir():
                if file.is_file():
                    (tmp_path / file.name).write_bytes(file.read_bytes())
            weights = load_file(source / "model.safetensors")
            edit(weights)
            save_file(weights, tmp_path / "model.safetensors")
            tokenizer = {"tokenizer": str(source / "tokenizer")} if name == "pi0" else {}
            policy: LeRobotPolicy = make(checkpoint=str(tmp_path), **tokenizer)
            return policy

        return load

    def test_an_unchanged_copy_loads(self, broken: Any) -> None:
        assert broken(lambda weights: None).spec.chunk_size > 0

    def test_a_missing_tensor_is_an_error_that_names_it(self, broken: Any) -> None:
        victim: list[str] = []

        def edit(weights: dict[str, torch.Tensor]) -> None:
            victim.append(sorted(weights)[3])
            del weights[victim[0]]

        with pytest.raises(CheckpointError) as caught:
            broken(edit)
        assert f"1 missing: {victim[0]}" in str(caught.value)

    def test_a_tensor_of_another_model_is_an_error(self, broken: Any) -> None:
        with pytest.raises(CheckpointError, match=r"1 unexpected: model\.stranger"):
            broken(lambda weights: weights.update({"model.stranger": torch.zeros(2)}))

    def test_another_shape_is_an_error_with_both_shapes(self, broken: Any) -> None:
        def edit(weights: dict[str, torch.Tensor]) -> None:
            key = next(k for k, v in weights.items() if v.ndim == 2)
            weights[key] = weights[key][:-1].clone()

        with pytest.raises(CheckpointError, match=r"1 of another shape: .*\(expected \(\d+, \d+\), found"):
            broken(edit)

    def test_another_precision_is_an_error(self, broken: Any) -> None:
        def edit(weights: dict[str, torch.Tensor]) -> None:
            key = next(k for k, v in weights.items() if v.ndim == 2)
            weights[key] = weights[key].to(torch.bfloat16)

        with pytest.raises(CheckpointError, match=r"expected torch.float32, found torch.bfloat16"):
            broken(edit)

    def test_a_weight_that_is_no_number_is_an_error(self, broken: Any) -> None:
        def edit(weights: dict[str, torch.Tensor]) -> None:
            key = next(k for k, v in weights.items() if v.ndim == 2)
            weights[key][0, 0] = float("nan")

        with pytest.raises(CheckpointError, match=r"not finite"):
            broken(edit)

    def test_a_checkpoint_without_weights_is_an_error(self, act: Path, tmp_path: Path, env: EnvSpec) -> None:
        (tmp_path / "config.json").write_text((act / "config.json").read_text())
        (tmp_path / "pytorch_model.bin").write_bytes(b"\x80\x04.")
        with pytest.raises(CheckpointError, match=r"never loaded: convert them to safetensors"):
            make_lerobot(context_for(env), checkpoint=str(tmp_path))

    def test_the_stock_loader_would_have_gone_on_with_random_weights(
        self, pi0: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """If this fails, lerobot was mended: the reason for a loader of our own may be gone."""
        from lerobot.policies.pi0.modeling_pi0 import PI0Policy

        config = read_config(pi0, LoadOptions(device="cpu"))
        with tiny_paligemma("pi0"):
            loaded = load_weights(pi0, config, LoadOptions(device="cpu"))
            random = PI0Policy.from_pretrained(tmp_path / "nothing", config=config)
        assert "Returning model without loading pretrained weights" in capsys.readouterr().out
        key = "model.action_out_proj.weight"
        assert not torch.equal(random.state_dict()[key], loaded.state_dict()[key])


class TestProcessors:
    def test_missing_statistics_are_an_error_that_names_them(
        self, act: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = copied(act, tmp_path)
        (state,) = folder.glob("policy_postprocessor_step_*.safetensors")
        tensors = {k: v for k, v in load_file(state).items() if not k.startswith("action.")}
        save_file(tensors, state)
        with pytest.raises(CheckpointError, match=r"no statistics for action\.mean, action\.std"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_code_that_is_no_processor_is_not_run(self, act: Path, tmp_path: Path, env: EnvSpec) -> None:
        folder = copied(act, tmp_path)
        file = folder / "policy_preprocessor.json"
        data = json.loads(file.read_text())
        data["steps"].append({"class": "os.system", "config": {"command": "true"}})
        file.write_text(json.dumps(data))
        with pytest.raises(CheckpointError, match=r"names the code 'os\.system'"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_a_missing_tokenizer_is_an_error_that_says_what_to_name(
        self, pi0: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        for file in pi0.iterdir():
            if file.is_file():
                (tmp_path / file.name).write_bytes(file.read_bytes())
        file = tmp_path / "policy_preprocessor.json"
        file.write_text(file.read_text().replace(str(pi0 / "tokenizer"), "google/paligemma-3b-pt-224"))
        with pytest.raises(CheckpointError, match=r"Name a local folder with `tokenizer`"):
            make_tiny(context_for(env), checkpoint=str(tmp_path))


HIDING = [kind for kind, row in FAMILIES.items() if row.why_not and row.adapter == LEROBOT]


class TestTypesThatHideFrames:
    @pytest.mark.parametrize("kind", sorted(HIDING))
    def test_they_are_refused_before_anything_is_loaded(
        self, act: Path, tmp_path: Path, env: EnvSpec, kind: str
    ) -> None:
        file = copied(act, tmp_path) / "config.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "type": kind}))
        with pytest.raises(CheckpointError, match=rf"'{kind}' cannot be evaluated .*lerobot-eval"):
            make_lerobot(context_for(env), checkpoint=str(tmp_path))

    @pytest.mark.parametrize(
        ("kind", "fields"), [("tdmpc", {}), ("vqbet", {"pretrained_backbone_weights": None})]
    )
    def test_lerobot_has_no_chunk_for_frames_from_outside(self, kind: str, fields: dict[str, Any]) -> None:
        config = PreTrainedConfig.get_choice_class(kind)(device="cpu", **fields)
        config.input_features = {
            "observation.images.base": PolicyFeature(FeatureType.VISUAL, (3, 128, 128)),
            "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
        }
        config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
        frames = {
            "observation.images.base": torch.zeros(1, 1, 3, 128, 128),
            "observation.state": torch.zeros(1, 1, 10),
        }
        with pytest.raises(RuntimeError, match="non-empty TensorList"):
            make_empty_policy(config).predict_action_chunk(frames)


class TestPlugins:
    def test_packages_are_looked_through_again_only_when_one_was_installed(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        looks: list[int] = []
        monkeypatch.syspath_prepend(tmp_path)
        os.utime(tmp_path, (0, 0))  # its next change is at another time, however coarse the clock
        monkeypatch.setattr(lerobot_loading, "register_third_party_plugins", lambda: looks.append(1))
        for _ in range(3):
            assert config_class("act", where="here").__name__ == "ACTConfig"
        assert len(looks) == 1
        (tmp_path / "lerobot_policy_late-1.0.dist-info").mkdir()
        config_class("act", where="here")
        assert len(looks) == 2


class TestFolders:
    def test_a_run_a_checkpoint_and_its_model_folder_are_the_same_policy(
        self, act: Path, tmp_path: Path
    ) -> None:
        model = tmp_path / "myrun/train/checkpoints/000300/pretrained_model"
        model.mkdir(parents=True)
        copied(act, model)
        (tmp_path / "myrun/train/checkpoints/last").symlink_to("000300")
        named = [tmp_path / "myrun", model.parent, model]
        assert {find_checkpoint(path).resolve() for path in named} == {model.resolve()}
        assert {checkpoint_name(path) for path in named} == {"myrun-000300"}
        assert len({checkpoint_sha256(path) for path in named}) == 1

    def test_one_changed_byte_changes_the_digest(self, act: Path, tmp_path: Path) -> None:
        folder = copied(act, tmp_path)
        before = checkpoint_sha256(folder)
        data = bytearray((folder / "model.safetensors").read_bytes())
        data[-1] ^= 1
        (folder / "model.safetensors").write_bytes(data)
        assert checkpoint_sha256(folder) != before

    def test_eval_takes_a_folder_and_notes_weights_and_dataset(
        self, act: Path, backbone: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if backbone == "small":
            monkeypatch.setattr(evaluate_module, "RUNNER", TINY_RUNNER)
        folder = tmp_path / "mine"
        folder.mkdir()
        copied(act, folder)
        write_facts(folder, FACTS)
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        arguments = ["--task", TASK, "--policy", str(folder), "--episodes", "2", "--workers", "1"]
        settings = [
            "--set",
            "simulator=fake",
            "--set",
            "env.horizon_steps=16",
            "--out",
            str(tmp_path / "run"),
        ]
        assert main(["eval", *arguments, *settings]) == 0
        run = read_run(tmp_path / "run")
        assert {(r.policy, r.n_action_steps, r.n_inferences) for r in run.records} == {("mine", 8, 2)}
        recipes = run.description.recipes
        assert recipes["policies/mine"] == recipes["checkpoints/mine"] == checkpoint_sha256(folder)
        assert recipes[f"datasets/{FACTS.dataset}"] == FACTS.dataset_sha256

    def test_another_dataset_of_the_same_name_is_noted_too_and_a_run_may_grow_by_its_policy(
        self, act: Path, tmp_path: Path
    ) -> None:
        digests = {"one": "a" * 64, "two": "b" * 64}
        for name, digest in digests.items():
            (tmp_path / name).mkdir()
            copied(act, tmp_path / name)
            write_facts(tmp_path / name, replace(FACTS, dataset_sha256=digest))

        def noted(*names: str) -> Mapping[str, str]:
            config = EvalConfig(
                name="c", tasks=(TASK,), policies=tuple(str(tmp_path / name) for name in names)
            )
            return plan_shard(config, None).recipe_hashes

        both = noted("one", "two")
        assert both[f"datasets/{FACTS.dataset}"] == digests["one"]
        assert both[f"datasets/{FACTS.dataset} of two"] == digests["two"]
        assert noted("one").items() <= both.items()

    def test_a_folder_without_a_checkpoint_says_what_is_in_it(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "notes.txt").touch()
        assert main(["eval", "--task", TASK, "--policy", str(tmp_path)]) == 1
        assert "expected a LeRobot checkpoint" in capsys.readouterr().err
