"""Tokenizers and backbones that a checkpoint names are read as data, whichever field or file names them."""

import contextlib
import json
import re
import types
import typing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from safetensors.torch import save_file

from tests.checkpoints import hostile_folders
from tests.checkpoints.hostile_folders import PAYLOADS, files_opened, other_than_data, write_hostile
from vla_eval.checkpoints.foreign_code import (
    no_foreign_code,
    only_data,
)
from vla_eval.checkpoints.loading import (
    LoadedPolicy,
    LoadOptions,
    config_class,
    make_empty_policy,
    read_config,
)
from vla_eval.cli.main import main
from vla_eval.errors import CheckpointError, VlaEvalError
from vla_eval.models.families import FAMILIES, family_of
from vla_eval.models.shared.tokens_read import Readings
from vla_eval.models.weights.empty import empty_weights
from vla_eval.policies.lerobot.policy import LeRobotPolicy
from vla_eval.testing.tiny_models import (
    tiny_paligemma,
    write_tiny_fast_tokenizer,
    write_tiny_tokenizer,
)

PI0_FAMILY = ("pi0", "pi05", "pi0_fast")

trace, cache = hostile_folders.trace, hostile_folders.cache
FIELDS = {
    "input_features": {
        "observation.images.base": {"type": "VISUAL", "shape": [3, 64, 64]},
        "observation.state": {"type": "STATE", "shape": [10]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [7]}},
}
with contextlib.suppress(VlaEvalError):
    config_class("none", where="")  # registers all
LEROBOTS = sorted(
    kind
    for kind in PreTrainedConfig.get_known_choices()
    if PreTrainedConfig.get_choice_class(kind).__module__.startswith("lerobot.policies.")
)
SAMPLE = ("act", "smolvla", "pi0_fast", "groot", "vla_jepa", "eo1")
"""Families that find their backbones in different ways; the others are under the marker `slow`."""
NAMES_FILES = re.compile("name|path|model|base|tokenizer|encoder|repo")
BACKBONES = ("auto_map", "imports_are_copied_first", "pickled_weights", "adapter")
TOKENIZERS = [
    name for name in PAYLOADS if "auto_map" in name or name in ("imports_are_copied_first", "generation")
]


class TestTokenizers:
    @pytest.mark.parametrize("key", ["vocab_file", "tokenizer_file", "merges_file", "spm_file"])
    @pytest.mark.parametrize("how", ["absolute", "by a link", "by dots"])
    def test_a_file_elsewhere_is_not_opened_as_its_vocabulary(
        self, tmp_path: Path, key: str, how: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder, outside = tmp_path / "tokenizer", tmp_path / "outside.json"
        folder.mkdir()
        outside.write_text("{}")
        (folder / "link.json").symlink_to(outside)
        monkeypatch.chdir(folder)
        named = {
            "absolute": str(outside),
            "by a link": str(folder / "link.json"),
            "by dots": "../outside.json",
        }
        settings = {"tokenizer_class": "GPT2Tokenizer", key: named[how]}
        (folder / "tokenizer_config.json").write_text(json.dumps(settings))
        with (
            files_opened() as opened,
            pytest.raises(CheckpointError, match=f"'{key}': expected a file of this folder"),
            only_data(),
        ):
            transformers.AutoTokenizer.from_pretrained(str(folder))
        assert not {outside, Path(named[how])} & set(opened)

    def test_what_a_tokenizer_names_of_another_machine_does_not_matter(self, tmp_path: Path) -> None:
        write_tiny_tokenizer(tmp_path)
        file = tmp_path / "tokenizer_config.json"
        old = {"special_tokens_map_file": str(tmp_path.parent), "name_or_path": str(tmp_path.parent)}
        file.write_text(json.dumps({**json.loads(file.read_text()), **old}))
        with only_data():
            assert transformers.AutoTokenizer.from_pretrained(str(tmp_path))("push the cube")["input_ids"]

    @pytest.mark.parametrize("payload", TOKENIZERS)
    def test_a_checkpoint_with_such_a_tokenizer_is_refused_with_one_message(
        self, tmp_path: Path, trace: Path, cache: Path, payload: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = tmp_path / "all" / "model"
        write_hostile(folder / "tokenizer", payload, trace)
        write_tiny_fast_tokenizer(folder / "action_tokenizer")
        (folder / "config.json").write_text(json.dumps({"type": "pi0_fast", **FIELDS}))
        for name in ("policy_preprocessor", "policy_postprocessor"):
            (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": []}))
        save_file({"w": torch.zeros(1)}, folder / "model.safetensors")
        with files_opened() as opened, tiny_paligemma("pi0_fast"):
            assert main(["checkpoint", "verify", str(folder)]) == 1
        said = capsys.readouterr().err
        assert said.count("mikasa-vla: error: ") == 1
        assert re.search("error: .*(It is not run|not called|cannot be read|could not be built)", said)
        assert not trace.exists()
        assert other_than_data(opened, tmp_path / "all") == []
        assert list(cache.iterdir()) == []


class TestEveryField:
    """A backbone is a checkpoint of its own, whichever field of a configuration names it."""

    @pytest.mark.parametrize(
        "kind", [pytest.param(kind, marks=() if kind in SAMPLE else pytest.mark.slow) for kind in LEROBOTS]
    )
    def test_a_payload_that_a_field_names_leaves_no_trace(
        self, tmp_path: Path, trace: Path, cache: Path, kind: str
    ) -> None:
        hints = typing.get_type_hints(PreTrainedConfig.get_choice_class(kind))
        fields = [name for name, hint in hints.items() if _is_text(hint) and name != "device"]
        assert "pretrained_path" in fields
        for field in fields:
            for payload in BACKBONES if NAMES_FILES.search(field) else ("auto_map",):
                folder = tmp_path / "all" / field / payload
                hostile = write_hostile(folder / "hostile", payload, trace)
                for part in ("vae", "text_encoder", "tokenizer", "processor"):
                    write_hostile(hostile / part, payload, trace)
                data = {"type": kind, **FIELDS, field: str(hostile)}
                (folder / "config.json").write_text(json.dumps(data))
                # A network of full size is built in half a second, of a dozen fields and four payloads.
                small = tiny_paligemma(kind) if kind in PI0_FAMILY else contextlib.nullcontext()
                with files_opened() as opened, small:
                    build(folder)
                assert not trace.exists(), (field, payload)
                assert other_than_data(opened, folder) == []
        assert list(cache.iterdir()) == []

    @pytest.mark.parametrize(
        ("kind", "field"),
        [
            ("gaussian_actor", "vision_encoder_name"),
            ("eo1", "vlm_base"),
            ("groot", "base_model_path"),
            ("vla_jepa", "qwen_model_name"),
            ("evo1", "vlm_model_name"),
        ],
    )
    @pytest.mark.parametrize(
        ("payload", "says"),
        [
            ("pickled_weights", r"expected the weights of a backbone as \.safetensors"),
            ("adapter", r"expected a whole model as a backbone, found an adapter"),
        ],
    )
    def test_what_was_opened_once_is_refused_with_a_message(
        self,
        tmp_path: Path,
        trace: Path,
        monkeypatch: pytest.MonkeyPatch,
        kind: str,
        field: str,
        payload: str,
        says: str,
    ) -> None:
        # The door is behind that refusal.
        monkeypatch.setitem(FAMILIES, kind, replace(family_of(kind), why_not=""))
        hostile = write_hostile(tmp_path / "all" / "author" / "hostile", payload, trace)
        data = {"type": kind, **FIELDS, field: str(hostile)}
        (tmp_path / "config.json").write_text(json.dumps(data))
        config = read_config(tmp_path, LoadOptions(device="cpu"))
        with pytest.raises(CheckpointError, match=says), empty_weights():
            make_empty_policy(config)

    def test_a_tokenizer_that_is_opened_in_the_first_forward_pass_goes_through_the_door(
        self, tmp_path: Path
    ) -> None:
        torch.save({}, tmp_path / "x.pt")

        class Lazy(LeRobotPolicy):
            def __init__(self) -> None:
                def lazy(*_: Any) -> Any:
                    return torch.load(tmp_path / "x.pt")

                config = types.SimpleNamespace(device="cpu", type="act", use_amp=False, dtype="float32")
                policy: Any = types.SimpleNamespace(reset=lazy)
                self._loaded = LoadedPolicy(
                    folder=tmp_path, config=config, policy=policy, preprocessor=None, postprocessor=None
                )
                self._readings, self._is_compiled = Readings(), False

        start = types.SimpleNamespace(instruction="lift it")
        episode: Any = types.SimpleNamespace(seed=lambda: 0, start=start)
        with pytest.raises(CheckpointError, match="would be unpickled"):
            Lazy()._infer([episode])


def _is_text(hint: Any) -> bool:
    return bool({str, Path} & {hint, *typing.get_args(hint)}) and typing.get_origin(hint) not in (list, dict)


def build(folder: Path) -> None:
    """Read a configuration, and make the policy and its processors of it, as far as it goes."""
    try:
        config = read_config(folder, LoadOptions(device="cpu"))
    except VlaEvalError:
        return
    with contextlib.suppress(VlaEvalError), empty_weights():
        make_empty_policy(config)
    with contextlib.suppress(Exception), no_foreign_code(config.type):  # lerobot's own raise what they like
        make_pre_post_processors(config)
