"""A checkpoint's JSON is read strictly: each kind of damage is one message, and nothing else is accepted."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from lerobot.policies.act.configuration_act import ACTConfig

from vla_eval.checkpoints.adapter_config import lora_fields
from vla_eval.checkpoints.config_check import check_config
from vla_eval.checkpoints.files import adapter_bases, checkpoint_sha256
from vla_eval.checkpoints.notes import normalization_notes
from vla_eval.checkpoints.saved_processor import read_saved_processor
from vla_eval.cli.main import main
from vla_eval.errors import CheckpointError
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.strict import json_fields as checkpoint_json
from vla_eval.strict.json_fields import parse_json, read_json

DAMAGED: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "Expecting value"),
    "cut": (b'{"a": ', "Expecting value"),
    "not UTF-8": (b'{"a": "\xff"}', "invalid start byte"),
    "half a surrogate pair": (rb'{"a": "\ud800"}', "surrogates not allowed"),
    "NaN": (b'{"a": NaN}', "NaN, which is no number of JSON"),
    "infinity": (b'{"a": -Infinity}', "-Infinity, which is no number"),
    "too large a number": (b'{"a": 1e999}', "1e999, which no number can hold"),
    "a number of 5,000 digits": (b'{"a": ' + b"1" * 5000 + b"}", "4300 digits"),
    "a field twice": (b'{"a": 1, "a": 2}', "the field 'a' twice"),
    "nested without end": (b"[" * 100_000, "nesting of more than 50 levels"),
    "nested 60 deep": (b'{"a": ' + b"[" * 60 + b"]" * 60 + b"}", "nesting of more than 50 levels"),
    "a list": (b'["a"]', "expected a mapping, found"),
    "a number": (b"5", "expected a mapping, found 5"),
}


class TestReading:
    @pytest.mark.parametrize("content, message", DAMAGED.values(), ids=DAMAGED.keys())
    def test_damage_is_one_message_with_the_file(self, tmp_path: Path, content: bytes, message: str) -> None:
        (tmp_path / "config.json").write_bytes(content)
        with pytest.raises(CheckpointError) as caught:
            read_json(tmp_path / "config.json")
        assert message in str(caught.value)
        assert str(caught.value).startswith(f"{tmp_path / 'config.json'}: ")
        assert "Fetch the checkpoint again" in str(caught.value)
        assert len(str(caught.value)) < 500 + len(str(tmp_path))

    def test_a_folder_is_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="expected a JSON file, found a folder"):
            read_json(tmp_path)

    def test_a_pipe_does_not_make_it_wait(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "config.json")
        with pytest.raises(CheckpointError, match="expected a JSON file, found something else"):
            read_json(tmp_path / "config.json")

    def test_a_huge_file_is_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(checkpoint_json, "MAX_BYTES", 1 << 20)
        (tmp_path / "config.json").write_bytes(b" " * ((1 << 20) + 1))
        with pytest.raises(CheckpointError, match="at most 1 MiB, found more"):
            read_json(tmp_path / "config.json")

    def test_what_json_has_is_read_as_it_is(self) -> None:
        data = {"a": [1, -2.5e-3, True, None, "ü"], "b": {"c": []}}
        assert parse_json(json.dumps(data).encode(), where="x") == data


def checkpoint(folder: Path, **files: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.safetensors").touch()
    for name, data in {"config": {"type": "act"}, **files}.items():
        (folder / f"{name}.json").write_text(json.dumps(data))
    return folder


class TestSteps:
    @pytest.mark.parametrize("steps", [None, 5, ["a"], {"a": 1}, [None], [[]], "x"])
    def test_steps_of_another_type_are_an_error(self, tmp_path: Path, steps: object) -> None:
        folder = checkpoint(tmp_path, policy_preprocessor={"steps": steps})
        with pytest.raises(CheckpointError, match=r"policy_preprocessor\.json: .*expected a (list|mapping)"):
            read_saved_processor(folder / "policy_preprocessor.json")
        with pytest.raises(CheckpointError, match=r"expected a (list|mapping)"):
            normalization_notes("lerobot", {"checkpoint": str(folder)})

    @pytest.mark.parametrize(
        ("step", "message"),
        [
            ({}, "expected a 'registry_name' or a 'class', found neither"),
            ({"registry_name": 5}, "'registry_name': expected text, found 5"),
            ({"class": ["a"]}, "'class': expected text"),
            ({"registry_name": "a", "config": [1]}, "'config': expected a mapping"),
            ({"registry_name": "a", "state_file": True}, "'state_file': expected text, found True"),
        ],
    )
    def test_a_step_of_another_form_is_an_error(self, tmp_path: Path, step: object, message: str) -> None:
        folder = checkpoint(tmp_path, policy_preprocessor={"steps": [{"registry_name": "x"}, step]})
        with pytest.raises(CheckpointError, match=f"step 2: {message}"):
            read_saved_processor(folder / "policy_preprocessor.json")

    @pytest.mark.parametrize(
        "config", [{"features": {"a": 5}}, {"features": [1]}, {"features": {"a": {"type": 3}}}]
    )
    def test_a_normaliser_of_another_form_is_an_error(self, tmp_path: Path, config: object) -> None:
        from safetensors.numpy import save_file

        step = {"registry_name": "normalizer_processor", "config": config, "state_file": "s.safetensors"}
        processor = {"steps": [step]}
        folder = checkpoint(tmp_path, policy_preprocessor=processor, policy_postprocessor=processor)
        save_file({}, folder / "s.safetensors")
        with pytest.raises(CheckpointError, match=r"step 1: '(a|features|type)': expected"):
            normalization_notes("lerobot", {"checkpoint": str(folder)})


class TestConfig:
    @pytest.mark.parametrize("value", [True, "4", 0, -1, 4.0, 10**9, [4], 10**4000])
    def test_a_number_of_steps_that_is_none_is_refused(self, tmp_path: Path, value: object) -> None:
        folder = checkpoint(tmp_path / "mine", config={"type": "act", "n_action_steps": value})
        with pytest.raises(
            CheckpointError, match="'n_action_steps': expected a whole number from 1 to 10,000"
        ):
            load_policy_recipe(str(folder))

    def test_without_one_a_policy_acts_once_per_inference(self, tmp_path: Path) -> None:
        folder = checkpoint(tmp_path / "mine", config={"type": "act"})
        assert load_policy_recipe(str(folder)).value.default_n_action_steps == 1

    @pytest.mark.parametrize(
        ("field", "value", "expected"),
        [
            ("chunk_size", 10**9, "a whole number from 1 to 10,000"),
            ("chunk_size", True, "a whole number"),
            ("chunk_size", "4", "a whole number"),
            ("chunk_size", None, "a whole number"),
            ("use_vae", 1, "true or false"),
            ("use_vae", "true", "true or false"),
            ("dropout", "0.1", "a number"),
            ("dropout", False, "a number"),
            ("vision_backbone", 5, "text"),
            ("input_features", [1], "a mapping"),
        ],
    )
    def test_a_field_of_another_type_is_refused(self, field: str, value: object, expected: str) -> None:
        with pytest.raises(CheckpointError, match=f"c: '{field}': expected .*{expected}"):
            check_config(ACTConfig, {field: value}, where="c")

    def test_what_lerobot_writes_is_accepted(self, tmp_path: Path) -> None:
        ACTConfig(device="cpu", push_to_hub=False).save_pretrained(tmp_path)
        data = read_json(tmp_path / "config.json")
        assert data.pop("type") == "act"
        check_config(ACTConfig, data, where="c")

    def test_the_command_line_prints_one_message(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = checkpoint(tmp_path / "mine", config={"type": "act", "n_action_steps": "4"})
        assert main(["eval", "--task", "RememberColor3-v0", "--policy", str(folder)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("mikasa-vla: error: ")
        assert "'n_action_steps': expected a whole number" in line


class TestAdapters:
    def test_an_adapter_that_is_its_own_base_is_refused(self, tmp_path: Path) -> None:
        folder = tmp_path / "mine"
        checkpoint(folder, adapter_config={"base_model_name_or_path": str(folder)})
        for ask in (checkpoint_sha256, adapter_bases, lambda path: load_policy_recipe(str(path))):
            with pytest.raises(CheckpointError, match="which is the adapter itself or stands on it"):
                ask(folder)

    def test_two_adapters_that_are_each_others_base_are_refused(self, tmp_path: Path) -> None:
        one, other = tmp_path / "one", tmp_path / "other"
        checkpoint(one, adapter_config={"base_model_name_or_path": str(other)})
        checkpoint(other, adapter_config={"base_model_name_or_path": str(one)})
        with pytest.raises(CheckpointError, match="stands on it"):
            checkpoint_sha256(one)
        with pytest.raises(CheckpointError, match="stands on it"):
            adapter_bases(one, base_checkpoint=str(one))

    def test_the_digest_of_an_adapter_is_made_of_its_own_files_and_its_bases(self, tmp_path: Path) -> None:
        base = checkpoint(tmp_path / "base")
        lora = checkpoint(tmp_path / "lora", adapter_config={"base_model_name_or_path": str(base)})
        before = checkpoint_sha256(lora)
        (base / "model.safetensors").write_bytes(b"x")
        assert checkpoint_sha256(lora) != before

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("peft_type", "XLORA"),
            ("peft_type", None),
            ("r", True),
            ("r", 10**9),
            ("lora_alpha", "8"),
            ("lora_alpha", -1),
            ("lora_dropout", [0]),
            ("target_modules", 5),
            ("target_modules", [5]),
            ("modules_to_save", "head"),
            ("bias", "loud"),
            ("bias", ["none"]),
            ("use_dora", "yes"),
            ("rank_pattern", [1]),
            ("rank_pattern", {"a": "b"}),
            ("init_lora_weights", "pissa"),
            ("init_lora_weights", {"a": 1}),
            ("base_model_name_or_path", 5),
        ],
    )
    def test_a_field_that_plain_lora_does_not_have_is_refused(self, field: str, value: object) -> None:
        data = {"peft_type": "LORA", "r": 4, "target_modules": ["q"], field: value}
        with pytest.raises(
            CheckpointError, match=rf"a: .*'{field}(\[0\])?': expected|a: .*{field}: 'a': expected"
        ):
            lora_fields(data, where="a")
