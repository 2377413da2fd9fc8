"""While a checkpoint is open no library imports, copies, unpickles or opens anything but data.

The payloads are those of `hostile_folders`. Each is given to every loader of transformers.
"""

import contextlib
import importlib
import pickle
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lerobot
import pytest
import torch
import torchvision
import transformers

from tests.checkpoints import hostile_folders
from tests.checkpoints.hostile_folders import PAYLOADS, files_opened, other_than_data, write_hostile
from vla_eval.checkpoints.backbones import fetched_backbones
from vla_eval.checkpoints.closed_doors import functions_of, refuse
from vla_eval.checkpoints.foreign_code import (
    ADAPTERS,
    COPY_AND_IMPORT,
    LEFT_OPEN,
    no_foreign_code,
    only_data,
)
from vla_eval.errors import CheckpointError

trace, cache = hostile_folders.trace, hostile_folders.cache
LOADERS = (
    *("AutoConfig", "AutoTokenizer", "AutoProcessor", "AutoImageProcessor", "AutoVideoProcessor"),
    *("AutoFeatureExtractor", "AutoModel", "AutoModelForCausalLM", "GenerationConfig", "GPT2Model"),
    *("GPT2Tokenizer", "PreTrainedTokenizerFast", "BarkProcessor"),
)
KNOWN: dict[str, set[str]] = {
    "transformers.dynamic_module_utils": {
        *("_sanitize_module_name", "init_hf_modules", "create_dynamic_module", "get_relative_imports"),
        *("get_relative_import_files", "get_imports", "check_imports", "get_class_in_module"),
        *("get_cached_module_file", "get_class_from_dynamic_module", "custom_object_save"),
        *("_raise_timeout_error", "resolve_trust_remote_code", "check_python_requirements"),
    },
    "diffusers.utils.dynamic_modules_utils": {
        *("get_diffusers_versions", "init_hf_modules", "create_dynamic_module", "get_relative_imports"),
        *("get_relative_import_files", "check_imports", "resolve_trust_remote_code", "get_class_in_module"),
        *("find_pipeline_class", "get_cached_module_file", "get_class_from_dynamic_module"),
    },
}
"""Functions that were looked at, in transformers 5.5 and diffusers 0.39."""


class TestEveryLoader:
    @pytest.mark.parametrize("payload", PAYLOADS)
    def test_a_payload_leaves_no_trace_and_opens_only_data(
        self, tmp_path: Path, trace: Path, cache: Path, payload: str
    ) -> None:
        hostile = write_hostile(tmp_path / "all" / "author" / "hostile", payload, trace)
        before = list(sys.path)
        with files_opened() as opened:
            for name in LOADERS:
                for trusted in (None, True):
                    # transformers raises what it likes of a damaged folder; ours comes out where we refuse
                    with contextlib.suppress(Exception), no_foreign_code("smolvla"):
                        getattr(transformers, name).from_pretrained(str(hostile), trust_remote_code=trusted)
        assert opened
        assert not trace.exists()
        assert other_than_data(opened, tmp_path / "all") == []
        assert sys.path == before
        assert list(cache.iterdir()) == []

    @pytest.mark.parametrize(
        ("payload", "loader", "says"),
        [
            ("auto_map", "AutoConfig", r"hostile names code of its own \(auto_map\).*not run"),
            ("auto_map", "AutoModel", r"hostile names code of its own"),
            ("imports_are_copied_first", "AutoTokenizer", r"hostile names code of its own"),
            (
                "pickled_weights",
                "AutoModel",
                r"hostile: expected the weights .* as \.safetensors, found none",
            ),
            ("pickled_shards", "GPT2Model", r"hostile: expected the weights .* as \.safetensors, found none"),
            ("shards_that_are_none", "AutoModel", r"part\.bin: expected a file whose name ends in \.safe"),
            ("shards_elsewhere", "AutoModel", r"above\.bin: expected a file whose name ends in \.safe"),
            (
                "adapter",
                "AutoModel",
                r"adapter_config\.json: expected a whole model as a backbone, found an ad",
            ),
            (
                "adapter",
                "GPT2Model",
                r"adapter_config\.json: expected a whole model as a backbone, found an ad",
            ),
            (
                "adapter_of_another",
                "AutoModel",
                r"adapter_config\.json: expected a whole model as a backbone",
            ),
            ("class_that_unpickles", "AutoTokenizer", r"names 'RagRetriever' of transformers"),
        ],
    )
    def test_the_refusal_is_what_the_user_sees(
        self, tmp_path: Path, trace: Path, payload: str, loader: str, says: str
    ) -> None:
        hostile = write_hostile(tmp_path / "all" / "author" / "hostile", payload, trace)
        with pytest.raises(CheckpointError, match=says), no_foreign_code("smolvla"):
            getattr(transformers, loader).from_pretrained(str(hostile), trust_remote_code=True)

    @pytest.mark.parametrize(
        "payload", ["auto_map", "imports_are_copied_first", "auto_map_of_another_repository"]
    )
    def test_the_payloads_do_run_where_nothing_is_closed(
        self, tmp_path: Path, trace: Path, cache: Path, payload: str
    ) -> None:
        hostile = write_hostile(tmp_path / "all" / "author" / "hostile", payload, trace)
        for name in ("AutoConfig", "AutoTokenizer"):
            with contextlib.suppress(Exception):
                getattr(transformers, name).from_pretrained(str(hostile), trust_remote_code=True)
        assert trace.exists()

    def test_an_honest_backbone_is_loaded_as_ever(self, tmp_path: Path) -> None:
        """With `auto_map` for a type that transformers has, and pickles beside it that nothing names."""
        from transformers import GPT2Config, GPT2Model

        config = GPT2Config(n_embd=4, n_layer=1, n_head=1, vocab_size=8, n_positions=8)
        config.auto_map = {"AutoConfig": "theirs.Theirs", "AutoModel": "theirs.Theirs"}
        made: Any = GPT2Model(config)
        made.save_pretrained(tmp_path)
        (tmp_path / "pytorch_model.bin").write_bytes(pickle.dumps({}))
        (tmp_path / "theirs.py").write_text("raise AssertionError")
        with no_foreign_code("smolvla"):
            found = transformers.AutoModel.from_pretrained(str(tmp_path), trust_remote_code=True)
        for key, tensor in made.state_dict().items():
            torch.testing.assert_close(found.state_dict()[key], tensor)


class TestDoors:
    @pytest.mark.parametrize("module", COPY_AND_IMPORT)
    def test_the_functions_of_the_installed_version_are_those_that_were_looked_at(self, module: str) -> None:
        """If this fails, there is a new one: say in foreign_code.py what becomes of it."""
        assert set(functions_of(module)) == KNOWN[module]

    @pytest.mark.parametrize(
        ("module", "name"),
        [(module, name) for module, names in KNOWN.items() for name in sorted(names - LEFT_OPEN)],
    )
    def test_each_refuses_wherever_it_was_imported(self, module: str, name: str) -> None:
        arguments = {
            ("transformers.dynamic_module_utils", "resolve_trust_remote_code"): (
                True,
                "hostile",
                False,
                True,
            ),
            ("diffusers.utils.dynamic_modules_utils", "resolve_trust_remote_code"): (True, "hostile", True),
        }.get((module, name), ("a.B", "hostile"))
        with only_data_once():
            pass
        function = getattr(importlib.import_module(module), name)
        places = [
            getattr(found, name)
            for found in list(sys.modules.values())
            if isinstance(vars(found).get(name) if hasattr(found, "__dict__") else None, type(function))
            and vars(found)[name].__module__ == module
        ]
        assert places
        for place in places:
            with pytest.raises(CheckpointError, match="not run"), only_data():
                place(*arguments)

    def test_a_refusal_that_is_swallowed_is_raised_in_the_end(self) -> None:
        def swallowing() -> None:
            with only_data(), contextlib.suppress(Exception):
                refuse("this one")

        with pytest.raises(CheckpointError, match="this one"):
            swallowing()
        with pytest.raises(CheckpointError, match="this one"), only_data():
            try:
                refuse("this one")
            except CheckpointError as exc:
                raise ImportError("another") from exc

    def test_other_threads_are_refused_too_and_nobody_is_afterwards(self, tmp_path: Path) -> None:
        file = tmp_path / "x.pt"
        torch.save({"a": torch.zeros(1)}, file)
        errors: list[BaseException] = []

        def load() -> None:
            try:
                torch.load(file)
            except CheckpointError as exc:
                errors.append(exc)

        with pytest.raises(CheckpointError, match=r"x\.pt: expected \.safetensors"), only_data():
            thread = threading.Thread(target=load)
            thread.start()
            thread.join()
        assert len(errors) == 1
        assert torch.load(file)["a"].shape == (1,)

    @pytest.mark.parametrize("load", [torch.load, torch.jit.load, torch.export.load, torch.hub.load])
    def test_nothing_is_unpickled(self, tmp_path: Path, load: Any) -> None:
        file = tmp_path / "x.pt"
        torch.save({"a": torch.zeros(1)}, file)
        with only_data_once():
            pass
        current: Any = importlib.import_module(load.__module__.removesuffix("._serialization"))
        with pytest.raises(CheckpointError, match="would be unpickled"), only_data():
            current.load(str(file))

    def test_a_module_that_is_imported_later_is_closed_too(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "imported_later.py").write_text("from torch import load as renamed\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        with pytest.raises(CheckpointError, match="would be unpickled"), only_data():
            importlib.import_module("imported_later").renamed("x.pt")

    @pytest.mark.parametrize("name", ["../x.json", "/x.json", "x.py", "x.bin", "x.gguf", "x.npy", "x"])
    def test_transformers_finds_no_other_file_by_name(self, tmp_path: Path, name: str) -> None:
        folder = tmp_path / "folder"
        folder.mkdir()
        (folder / name).write_text("") if not name.startswith("/") else None
        with (
            pytest.raises(CheckpointError, match=r"expected (a file whose name|names of files)"),
            only_data(),
        ):
            transformers.utils.hub.cached_file(str(folder), name)

    @pytest.mark.parametrize(("module", "name"), ADAPTERS)
    def test_peft_opens_no_adapter(self, module: str, name: str) -> None:
        with only_data_once():
            pass
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        with pytest.raises(CheckpointError, match="found an adapter, which peft would load"), only_data():
            found("a/folder")

    @pytest.mark.parametrize("installed", [True, False])
    def test_no_kernel_of_the_hub_is_loaded(self, monkeypatch: pytest.MonkeyPatch, installed: bool) -> None:
        kernels: Any = importlib.import_module("transformers.integrations.hub_kernels")
        monkeypatch.setattr(kernels, "_kernels_available", installed)
        monkeypatch.setattr(kernels, "get_kernel_hub", lambda *_, **__: pytest.fail("loaded"), raising=False)
        for load in ("get_kernel", "load_and_register_attn_kernel"):
            with (
                pytest.raises(CheckpointError, match="'kernels-community/x', compiled code"),
                only_data(),
            ):
                getattr(kernels, load)("kernels-community/x")
        with only_data():  # a network that asks for a faster one does without
            assert kernels.lazy_load_kernel("mamba-ssm", {}) is None

    def test_no_policy_of_lerobots_unpickles_or_runs_text_by_itself(self) -> None:
        """If this fails, a version of lerobot has a way that no door closes: see foreign_code.py."""
        runs = re.compile(r"\b(pickle|joblib|dill|marshal|shelve)\b|torch\.load\(|np\.load\(|yaml\.\w*load\(")
        runs_text = re.compile(r"(?<![.\w])(exec|eval)\(|exec_module|spec_from_file")
        root = Path(lerobot.__file__).parent
        files = [file for room in ("policies", "processor") for file in (root / room).rglob("*.py")]
        assert len(files) > 50
        texts = {file.relative_to(root).as_posix(): file.read_text() for file in files}
        assert {name for name, text in texts.items() if runs.search(text) or runs_text.search(text)} == set()

    def test_torchvisions_own_weights_are_still_read(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        weights = torchvision.models.ResNet34_Weights.IMAGENET1K_V1
        checkpoints = tmp_path / "checkpoints"
        checkpoints.mkdir()
        monkeypatch.setattr("torch.hub.get_dir", lambda: str(tmp_path))
        torch.save({"a": torch.zeros(1)}, checkpoints / weights.url.rpartition("/")[2])
        with no_foreign_code("act"), fetched_backbones():
            assert list(weights.get_state_dict(progress=False)) == ["a"]


@contextlib.contextmanager
def only_data_once() -> Iterator[None]:
    """Put the doors in their places."""
    with only_data():
        yield
