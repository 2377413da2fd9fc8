"""Run no Python code that a checkpoint, or a tokenizer that it names, brings along.

lerobot passes `trust_remote_code=True` with names that a checkpoint's configuration chooses, and transformers
looks up class names from files among all that it has. What is replaced here are the functions that all of
these go through; docs/security.md lists them.
"""

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator
from typing import Any  # transformers and lerobot are untyped
from unittest.mock import patch

from vla_eval.errors import CheckpointError
from vla_eval.policies.processor_door import processors_through_the_door

READS_ACTION_TOKENIZERS = (
    "lerobot.policies.pi0_fast.modeling_pi0_fast",
    "lerobot.processor.tokenizer_processor",
)
RUNS_CODE = "get_class_in_module"
"""The only function of transformers that executes a file; a test counts who calls it."""
CALLS_IT = ("transformers.dynamic_module_utils", "transformers.generation.utils")
CLASSES_BY_NAME = {
    "tokenization_auto": "tokenizer_class_from_name",
    "processing_auto": "processor_class_from_name",
    "image_processing_auto": "get_image_processor_class_from_name",
    "feature_extraction_auto": "feature_extractor_class_from_name",
    "video_processing_auto": "video_processor_class_from_name",
}
"""Where transformers takes the name of a class from a file; what it has of that name is then called."""


@contextlib.contextmanager
def no_foreign_code(kind: str) -> Iterator[None]:
    """Let nothing that a checkpoint names be run within the context, unless it is checked or installed.

    Args:
        kind: lerobot's type of policy. The action tokenizer of `pi0_fast` is read as data.

    Raises:
        CheckpointError: from within, where such code would have been imported.
    """
    loading: Any = importlib.import_module("transformers.dynamic_module_utils")
    kernels: Any = importlib.import_module("transformers.integrations.hub_kernels")
    with contextlib.ExitStack() as stack:
        stack.enter_context(processors_through_the_door())
        for name in CALLS_IT:
            if name in sys.modules:  # one that is imported later takes over what stands in `loading`
                stack.enter_context(patch.object(sys.modules[name], RUNS_CODE, _refuse))
        stack.enter_context(patch.object(loading, "TIME_OUT_REMOTE_CODE", 0))  # the user is not asked, either
        stack.enter_context(patch.object(kernels, "_kernels_available", False))  # compiled code of the Hub
        for name, function in CLASSES_BY_NAME.items():
            module: Any = importlib.import_module(f"transformers.models.auto.{name}")
            stack.enter_context(patch.object(module, function, _only_data(getattr(module, function))))
        if kind == "pi0_fast":
            from vla_eval.policies.fast_tokens import FastProcessors

            for name in READS_ACTION_TOKENIZERS:
                stack.enter_context(
                    patch.object(importlib.import_module(name), "AutoProcessor", FastProcessors)
                )
        yield


def _refuse(class_name: str, module_path: object, **_: object) -> Any:
    raise CheckpointError(
        f"the class '{class_name}' is in {module_path}, code that comes with a checkpoint or with a "
        "tokenizer. It is not run. If you trust it, LeRobot's own loop does: lerobot-eval --env.type=mikasa "
        "(docs/lerobot_commands.md)."
    )


def _only_data(look_up: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return the function of transformers, which then finds tokenizers and processors only."""

    def checked(class_name: str) -> Any:
        found = look_up(class_name)
        if found is not None and not _reads_data(found):
            raise CheckpointError(
                f"a file names '{class_name}' of transformers as its tokenizer or processor, which is none. "
                "It is not called. Fetch the checkpoint again, from where you trust it."
            )
        return found

    return checked


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
