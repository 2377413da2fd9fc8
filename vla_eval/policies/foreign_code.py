"""Run no Python code that a checkpoint, or a tokenizer that it names, brings along.

lerobot passes `trust_remote_code=True` with names that a checkpoint's configuration chooses.
"""

import contextlib
import importlib
from collections.abc import Iterator
from typing import Any  # transformers and lerobot are untyped
from unittest.mock import patch

from vla_eval.errors import CheckpointError

READS_ACTION_TOKENIZERS = (
    "lerobot.policies.pi0_fast.modeling_pi0_fast",
    "lerobot.processor.tokenizer_processor",
)


@contextlib.contextmanager
def no_foreign_code(kind: str) -> Iterator[None]:
    """Let transformers import nothing that is not installed, within the context.

    Args:
        kind: lerobot's type of policy. The action tokenizer of `pi0_fast` is read as data.

    Raises:
        CheckpointError: from within, where such code would have been imported.
    """
    loading: Any = importlib.import_module("transformers.dynamic_module_utils")
    with contextlib.ExitStack() as stack:
        stack.enter_context(patch.object(loading, "get_class_in_module", _refuse))
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
