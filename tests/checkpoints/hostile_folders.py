"""Folders as a repository of the Hub has them, each with another payload that writes a file if it runs."""

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from vla_eval.checkpoints.foreign_code import COPY_AND_IMPORT, DATA

AUTO = (
    *("AutoConfig", "AutoModel", "AutoModelForCausalLM", "AutoModelForImageTextToText", "AutoBackbone"),
    *("AutoImageProcessor", "AutoVideoProcessor", "AutoFeatureExtractor", "AutoProcessor"),
)
SETTINGS = (
    *("config.json", "processor_config.json", "preprocessor_config.json", "video_preprocessor_config.json"),
    "audio_tokenizer_config.json",
)
SWALLOWED = """
class Theirs:
    @classmethod
    def register_for_auto_class(cls):
        raise OSError("as of a missing file, which AutoTokenizer ignores")
"""
TINY: dict[str, Any] = {  # of a network that transformers builds in no time
    **{"model_type": "gpt2", "n_embd": 4, "n_layer": 1, "n_head": 1, "vocab_size": 8, "n_positions": 8},
    "architectures": ["GPT2LMHeadModel"],
}


class WritesWhenUnpickled:
    """Touches a file when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.trace), "w"))


def _describe(folder: Path, file: str, **data: Any) -> None:
    (folder / file).write_text(json.dumps(data))


def _named(folder: Path, reference: str, **more: Any) -> None:
    """Let every file that may name code name it."""
    auto_map = dict.fromkeys(AUTO, reference)
    for file in SETTINGS:
        _describe(folder, file, auto_map=auto_map, **more)
    _describe(folder, "tokenizer_config.json", auto_map={"AutoTokenizer": [reference, reference]}, **more)


def _code(trace: Path) -> str:
    return f"open({str(trace)!r}, 'w').close()\nclass Theirs: ...\ndef generate(*_, **__): ...\n"


def auto_map(folder: Path, trace: Path) -> None:
    """Code beside the files that name it."""
    _named(folder, "theirs.Theirs")


def auto_map_of_a_known_type(folder: Path, trace: Path) -> None:
    """The same for a network that transformers has."""
    _named(folder, "theirs.Theirs", **TINY)


def auto_map_of_another_repository(folder: Path, trace: Path) -> None:
    """The code is in another folder."""
    other = folder.with_name(f"{folder.name}-other")
    other.mkdir()
    (other / "theirs.py").write_text(_code(trace))
    _named(folder, f"{other}--theirs.Theirs")


def auto_map_in_a_subfolder(folder: Path, trace: Path) -> None:
    """The code's name leads up."""
    (folder.parent / "above.py").write_text(_code(trace))
    _named(folder, "../above.Theirs")


def auto_map_as_a_list(folder: Path, trace: Path) -> None:
    """As old tokenizers have it."""
    _describe(folder, "tokenizer_config.json", auto_map=["theirs.Theirs", None], tokenizer_class="Theirs")
    _describe(folder, "config.json", auto_map={"AutoConfig": "theirs.Theirs"}, model_type="theirs")


def imports_are_copied_first(folder: Path, trace: Path) -> None:
    """What a file imports is copied into the cache of modules, and imported, before the file itself is."""
    for index in range(4):
        (folder.parent.parent / f"evil{index}.py").write_text(_code(trace))
    names = "".join(f"from .../../evil{index} import x\n" for index in range(4))
    (folder / "copied.py").write_text(f'"""\n{names}"""\n{SWALLOWED}')
    imports = "".join(f"import evil{index}\n" for index in range(4))
    (folder / "theirs.py").write_text(f"{imports}class Theirs: ...\n")
    _describe(folder, "config.json", model_type="x", auto_map=dict.fromkeys(AUTO, "copied.Theirs"))
    _describe(folder, "tokenizer_config.json", auto_map={"AutoTokenizer": [None, "theirs.Theirs"]})


def pickled_weights(folder: Path, trace: Path) -> None:
    """Weights in torch's format."""
    _describe(folder, "config.json", **TINY)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "pytorch_model.bin")


def pickled_weights_of_old(folder: Path, trace: Path) -> None:
    """Weights in torch's format of before 1.6, which is a bare pickle."""
    _describe(folder, "config.json", **TINY)
    pickled = {"a": WritesWhenUnpickled(trace)}
    torch.save(pickled, folder / "pytorch_model.bin", _use_new_zipfile_serialization=False)


def pickled_shards(folder: Path, trace: Path) -> None:
    """Several of them, with an index."""
    _describe(folder, "config.json", **TINY)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "part.bin")
    _describe(folder, "pytorch_model.bin.index.json", metadata={}, weight_map={"a": "part.bin"})


def shards_that_are_none(folder: Path, trace: Path) -> None:
    """An index of safetensors that names pickles."""
    _describe(folder, "config.json", **TINY)
    for name in ("part.bin", "part.pt"):
        torch.save({"a": WritesWhenUnpickled(trace)}, folder / name)
    _describe(
        folder, "model.safetensors.index.json", metadata={}, weight_map={"a": "part.bin", "b": "part.pt"}
    )


def shards_elsewhere(folder: Path, trace: Path) -> None:
    """The same, with a name that leads up."""
    _describe(folder, "config.json", **TINY)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder.parent / "above.bin")
    _describe(folder, "model.safetensors.index.json", metadata={}, weight_map={"a": "../above.bin"})


def named_weights(folder: Path, trace: Path) -> None:
    """A configuration that names the file of its weights."""
    _describe(folder, "config.json", transformers_weights="adapter_model.bin", **TINY)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "adapter_model.bin")


def pickle_in_disguise(folder: Path, trace: Path) -> None:
    """A pickle with the name of safetensors."""
    _describe(folder, "config.json", **TINY)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "model.safetensors")


def adapter(folder: Path, trace: Path) -> None:
    """An adapter on a whole model, with pickled weights and a module for peft to import."""
    _describe(folder, "config.json", **TINY)
    save_file({"a": torch.zeros(1)}, folder / "model.safetensors", metadata={"format": "pt"})
    described = {"peft_type": "LORA", "r": 2, "target_modules": ["c_attn"], "megatron_core": "theirs"}
    _describe(folder, "adapter_config.json", megatron_config={"a": 1}, **described)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "adapter_model.bin")


def adapter_of_another(folder: Path, trace: Path) -> None:
    """An adapter alone, whose base is another folder."""
    other = folder.with_name(f"{folder.name}-base")
    other.mkdir()
    auto_map(other, trace)
    (other / "theirs.py").write_text(_code(trace))
    described = {"peft_type": "LORA", "r": 2, "base_model_name_or_path": str(other)}
    _describe(folder, "adapter_config.json", auto_mapping={"parent_library": "theirs"}, **described)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "adapter_model.bin")


def kernel_of_the_hub(folder: Path, trace: Path) -> None:
    """Compiled code as the implementation of attention."""
    _describe(folder, "config.json", **TINY, attn_implementation=f"{folder}/x:theirs")
    (folder / "build.toml").write_text("")


def class_that_unpickles(folder: Path, trace: Path) -> None:
    """A class of transformers that reads pickles, in the place of a tokenizer or processor."""
    for name in ("tokenizer_config.json", *SETTINGS):
        _describe(folder, name, tokenizer_class="RagRetriever", processor_class="RagRetriever", **TINY)


def pickled_voices(folder: Path, trace: Path) -> None:
    """Arrays that a processor of sound reads, pickled."""
    torch.save(WritesWhenUnpickled(trace), folder / "voice.npy")
    _describe(folder, "config.json", model_type="bark")
    _describe(folder, "processor_config.json", processor_class="BarkProcessor")
    voices = {"repo_or_path": str(folder), "v": {"semantic_prompt": "voice.npy"}}
    _describe(folder, "speaker_embeddings_path.json", **voices)
    _describe(folder, "tokenizer_config.json", tokenizer_class="BertTokenizer")


def gguf(folder: Path, trace: Path) -> None:
    """Another format of weights."""
    _describe(folder, "config.json", gguf_file="model.gguf", **TINY)
    torch.save({"a": WritesWhenUnpickled(trace)}, folder / "model.gguf")


def generation(folder: Path, trace: Path) -> None:
    """A way to generate, as code, in a model that is honest otherwise."""
    (folder / "custom_generate").mkdir()
    (folder / "custom_generate" / "generate.py").write_text(_code(trace))
    (folder / "custom_generate" / "requirements.txt").write_text("theirs")
    _describe(folder, "config.json", **TINY)
    _describe(folder, "generation_config.json", custom_generate="theirs.generate")


PAYLOADS: Mapping[str, Callable[[Path, Path], None]] = {
    make.__name__: make
    for make in (
        *(auto_map, auto_map_of_a_known_type, auto_map_of_another_repository, auto_map_in_a_subfolder),
        *(auto_map_as_a_list, imports_are_copied_first, pickled_weights, pickled_weights_of_old),
        *(pickled_shards, shards_that_are_none, shards_elsewhere, named_weights, pickle_in_disguise),
        *(adapter, adapter_of_another, kernel_of_the_hub, class_that_unpickles, pickled_voices),
        *(gguf, generation),
    )
}
"""Name -> writes the files into a folder."""


def write_hostile(folder: Path, payload: str, trace: Path) -> Path:
    """Make such a folder; beside the payload it has code, which nothing of it names, and pickles.

    Some payloads write beside it and above, as far as the second folder above it.
    """
    folder.mkdir(parents=True)
    for name in ("theirs.py", "__init__.py", "modeling.py", "tok.py"):
        (folder / name).write_text(_code(trace))
    for name in ("optimizer.pt", "training_args.bin", "model.ckpt", "vocab.pkl"):
        torch.save(WritesWhenUnpickled(trace), folder / name)
    PAYLOADS[payload](folder, trace)
    return folder


_watched: list[list[Path]] = []


def _note(event: str, args: tuple[Any, ...]) -> None:
    if event == "open" and _watched and isinstance(args[0], str | Path):
        _watched[-1].append(Path(args[0]))


sys.addaudithook(_note)  # of Python's own calls; what opens files natively is given data alone


@contextlib.contextmanager
def files_opened() -> Iterator[list[Path]]:
    """Give the list of the files that Python opens within the context."""
    opened: list[Path] = []
    _watched.append(opened)
    try:
        yield opened
    finally:
        _watched.remove(opened)


def other_than_data(opened: list[Path], folder: Path) -> list[Path]:
    return [file for file in opened if file.is_relative_to(folder) and file.suffix not in DATA]


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """What a payload writes if it runs."""
    return tmp_path / "it-ran"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache of modules, where an earlier program has left some and which Python searches."""
    modules = tmp_path / "cache-of-modules"
    modules.mkdir()
    for module in COPY_AND_IMPORT:
        monkeypatch.setattr(f"{module}.HF_MODULES_CACHE", str(modules))
    monkeypatch.syspath_prepend(str(modules))
    return modules
