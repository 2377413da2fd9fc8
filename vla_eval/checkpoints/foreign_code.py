"""Run no Python code that a checkpoint, tokenizer or backbone brings along: docs/security.md."""

import contextlib
import functools
import importlib
import inspect
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn  # transformers and lerobot are untyped
from unittest.mock import patch

from vla_eval.checkpoints.closed_doors import Door, closed, functions_of, refuse, replace
from vla_eval.checkpoints.safe_processors import processors_through_the_door
from vla_eval.checkpoints.saved_processor import leads_out
from vla_eval.models.families import family_of
from vla_eval.models.family import imported
from vla_eval.strict.json_fields import FETCH_AGAIN, read_json
from vla_eval.strict.json_text import shown

COPY_AND_IMPORT = ("transformers.dynamic_module_utils", "diffusers.utils.dynamic_modules_utils")
"""They copy code files into a cache, import what these import, and run them: nothing of it is left open."""
LEFT_OPEN = frozenset({"custom_object_save", "_sanitize_module_name", "find_pipeline_class"})
"""Of these: what writes the code of a class that was imported, and what computes with names."""
ASKS = "resolve_trust_remote_code"
CLASSES_BY_NAME = {
    "tokenization_auto": "tokenizer_class_from_name",
    "processing_auto": "processor_class_from_name",
    "image_processing_auto": "get_image_processor_class_from_name",
    "feature_extraction_auto": "feature_extractor_class_from_name",
    "video_processing_auto": "video_processor_class_from_name",
}
"""Where transformers takes the name of a class from a file; what it has of that name is then called."""
UNPICKLES = (
    ("torch.serialization", "load"),
    ("torch.jit._serialization", "load"),
    ("torch.export", "load"),
    ("torch.hub", "load"),
    ("torch.hub", "load_state_dict_from_url"),
)
KERNELS = "transformers.integrations.hub_kernels"
ADAPTERS = (
    ("peft.config", "PeftConfigMixin.from_pretrained"),
    ("peft.config", "PeftConfigMixin.from_json_file"),
    ("peft.peft_model", "PeftModel.from_pretrained"),
    ("peft.peft_model", "PeftModel.load_adapter"),
    ("peft.mixed_model", "PeftMixedModel.from_pretrained"),
    ("peft.mixed_model", "PeftMixedModel.load_adapter"),
    ("peft.auto", "_BaseAutoPeftModel.from_pretrained"),
    ("peft.utils.save_and_load", "load_peft_weights"),
    ("transformers.integrations.peft", "PeftAdapterMixin.load_adapter"),
)
WEIGHTS = ".safetensors"
DATA = frozenset(
    {WEIGHTS, ".json", ".jinja", ".txt", ".model", ".spm", ".vocab", ".codes", ".tokenizer", ".tiktoken"}
)
"""Endings of the files that transformers may open: weights, JSON, templates and vocabularies."""
TOKENIZER_CONFIG = "tokenizer_config.json"
NOT_OPENED = "special_tokens_map_file"
"""Of old tokenizers: where it lay on the machine that saved it."""
MODULES_CACHE = "HF_MODULES_CACHE"
TRUSTS = (
    "If you trust it, LeRobot's own loop does: lerobot-eval --env.type=mikasa (docs/lerobot_commands.md)."
)


@contextlib.contextmanager
def no_foreign_code(kind: str) -> Iterator[None]:
    """Let nothing that a checkpoint names be run while it is loaded, unless checked or installed."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(only_data())
        stack.enter_context(processors_through_the_door())
        stack.enter_context(_no_cache_of_modules())
        for replaced, ours in family_of(kind).replaces.items():
            module, _, name = replaced.partition(":")
            stack.enter_context(patch.object(importlib.import_module(module), name, imported(ours)))
        yield


@contextlib.contextmanager
def only_data() -> Iterator[None]:
    """Keep the doors closed, as `no_foreign_code`; cheap enough for every forward pass."""
    replace(_doors())
    with closed():
        yield


@functools.cache
def _doors() -> tuple[Door, ...]:
    code = [
        Door(module=module, name=name, guard=_without_code if name == ASKS else _refuse_code(name))
        for module in COPY_AND_IMPORT
        for name in functions_of(module)
        if name not in LEFT_OPEN
    ]
    classes = [
        Door(module=f"transformers.models.auto.{module}", name=name, guard=_only_data_class)
        for module, name in CLASSES_BY_NAME.items()
    ]
    pickles = [Door(module=module, name=name, guard=_refuse_pickle) for module, name in UNPICKLES]
    kernels = [
        Door(module=KERNELS, name="get_kernel", guard=_refuse_kernel),
        Door(module=KERNELS, name="load_and_register_attn_kernel", guard=_refuse_kernel),
        Door(module=KERNELS, name="lazy_load_kernel", guard=_without_kernels),
    ]
    adapters = [Door(module=module, name=name, guard=_refuse_adapter) for module, name in ADAPTERS]
    files = [
        Door(module="transformers.utils.hub", name="cached_files", guard=_data_files),
        Door(module="transformers.modeling_utils", name="_get_resolved_checkpoint_files", guard=_safetensors),
        Door(module="transformers.utils.peft_utils", name="find_adapter_config_file", guard=_no_adapter),
    ]
    return (*code, *classes, *pickles, *kernels, *adapters, *files)


def _refuse_code(name: str) -> Callable[..., NoReturn]:
    def guard(_original: object, *args: object, **kwargs: object) -> NoReturn:
        what, where, *_ = *args, *kwargs.values(), "?", "?"
        if name == "get_cached_module_file":
            what, where = where, what
        refuse(
            f"{str(what)[:100]!r} is in {where!s:.300}, code that comes with a checkpoint, a tokenizer or a "
            f"backbone ({name}). It is not run. {TRUSTS}"
        )

    return guard


def _without_code(original: Callable[..., Any], *args: Any, **kwargs: Any) -> bool:
    """Answer for the user: a class that is installed is taken; where there is only code, it is refused."""
    given = inspect.signature(original).bind(*args, **kwargs).arguments
    if given.get("has_remote_code") and not given.get("has_local_code"):
        refuse(
            f"{given['model_name']!s:.300} names code of its own (auto_map), which comes with a "
            f"checkpoint, a tokenizer or a backbone. It is not run. {TRUSTS}"
        )
    return False


def _only_data_class(look_up: Callable[..., Any], class_name: str, *args: Any, **kwargs: Any) -> Any:
    """Find tokenizers and processors only."""
    found = look_up(class_name, *args, **kwargs)
    if found is not None and not _reads_data(found):
        refuse(
            f"a file names '{class_name!s:.100}' of transformers as its tokenizer or processor, which is "
            f"none. It is not called. {FETCH_AGAIN}"
        )
    return found


def _reads_data(found: Any) -> bool:
    from transformers import (
        FeatureExtractionMixin,
        ImageProcessingMixin,
        PreTrainedTokenizerBase,
        ProcessorMixin,
    )

    if type(found).__name__ == "DummyObject":  # stands for a package that is not installed, and says so
        return True
    kinds = (PreTrainedTokenizerBase, ProcessorMixin, FeatureExtractionMixin, ImageProcessingMixin)
    return isinstance(found, type) and issubclass(found, kinds)


def _refuse_pickle(_original: object, file: object = "?", *_: object, **__: object) -> NoReturn:
    refuse(
        f"{file!s:.300}: expected {WEIGHTS}, found a file that would be unpickled. Files of other formats "
        "(.bin, .pt, .ckpt) are never loaded: convert it to safetensors."
    )


def _refuse_kernel(_original: object, name: object = "?", *_: object, **__: object) -> NoReturn:
    refuse(
        f"a file names the kernel {str(name)[:100]!r}, compiled code of the Hub. It is not loaded. "
        f"{FETCH_AGAIN}"
    )


def _without_kernels(look_up: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Let a network that asks for a faster kernel of the Hub do without; an installed package is taken."""
    return None if sys.modules[KERNELS]._kernels_available else look_up(*args, **kwargs)


def _refuse_adapter(_original: object, *args: object, **_: object) -> NoReturn:
    named = next((f"{arg!s:.300}" for arg in args if isinstance(arg, str | Path)), "a backbone")
    refuse(f"{named}: {ADAPTER_OF_BACKBONE}")


ADAPTER_OF_BACKBONE = (
    "expected a whole model as a backbone, found an adapter, which peft would load. Merge it into its base "
    "with the program that made it."
)


def _no_adapter(find: Callable[..., str | None], *args: Any, **kwargs: Any) -> str | None:
    found = find(*args, **kwargs)
    if found is not None:
        refuse(f"{found!s:.300}: {ADAPTER_OF_BACKBONE}")
    return None


def _data_files(
    find: Callable[..., list[str] | None], path_or_repo_id: Any, filenames: list[str], **kwargs: Any
) -> list[str] | None:
    """Find files by name as ever; refuse one that is there and is not on the list, before it is opened."""
    for name in filenames:
        if Path(str(name)).is_absolute() or ".." in Path(str(name)).parts:
            refuse(
                f"{path_or_repo_id!s:.300}: expected names of files in this folder, found "
                f"{str(name)[:200]!r}. It is not opened."
            )
    found = find(path_or_repo_id, filenames, **kwargs)
    for file in found or ():
        if file is not None:
            _check_ending(file, DATA)
            if Path(file).name == TOKENIZER_CONFIG:
                _check_named_files(Path(file))
    return found


def _check_named_files(config: Path) -> None:
    """Refuse a tokenizer that names files elsewhere as its own: transformers would open them."""
    for key, value in read_json(config).items():
        is_file = key.endswith("_file") and key != NOT_OPENED and isinstance(value, str)
        if is_file and os.path.exists(value) and leads_out(os.path.abspath(value), config.parent):
            refuse(
                f"{config}: {key!r:.100}: expected a file of this folder, found {shown(value)}. {FETCH_AGAIN}"
            )


def _safetensors(find: Callable[..., tuple[list[str] | None, Any]], *args: Any, **kwargs: Any) -> Any:
    """Find the weights of a backbone, which are safetensors or none."""
    gguf = kwargs.get("gguf_file")
    if gguf:
        _check_ending(str(gguf), frozenset({WEIGHTS}))
    kwargs["use_safetensors"] = True
    try:
        found = find(*args, **kwargs)
    except OSError as exc:
        folder = kwargs.get("pretrained_model_name_or_path", args[0] if args else "?")
        if not os.path.isdir(str(folder)):
            raise  # not fetched; transformers says so
        refuse(
            f"{folder!s:.300}: expected the weights of a backbone as {WEIGHTS}, found none ({exc!s:.300}). "
            "Files of other formats (.bin, .pt, .ckpt) are never loaded: convert them to safetensors."
        )
    for file in found[0] or ():
        _check_ending(file, frozenset({WEIGHTS}))
    return found


def _check_ending(file: str, endings: frozenset[str]) -> None:
    if Path(file).suffix not in endings:
        refuse(
            f"{file!s:.300}: expected a file whose name ends in {', '.join(sorted(endings))}; others are not "
            f"opened. {FETCH_AGAIN}"
        )


@contextlib.contextmanager
def _no_cache_of_modules() -> Iterator[None]:
    """Let the cache that code would be copied into be an empty one, and import nothing from the user's."""
    with contextlib.ExitStack() as stack:
        empty = stack.enter_context(tempfile.TemporaryDirectory(prefix="mikasa-vla-no-modules-"))
        caches = set()
        for module in list(sys.modules.values()):
            cache = getattr(module, "__dict__", {}).get(MODULES_CACHE)
            if isinstance(cache, str):
                caches.add(os.path.realpath(cache))
                stack.enter_context(patch.object(module, MODULES_CACHE, empty))
        searched = [place for place in sys.path if os.path.realpath(place) not in caches]
        stack.enter_context(patch.object(sys, "path", searched))
        yield
