"""The one door for saved processors: a name is looked at as text before anything is imported."""

import contextlib
import importlib
import importlib.metadata
import importlib.util
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any  # lerobot is untyped
from unittest.mock import patch

from lerobot.processor import DataProcessorPipeline, ProcessorStep, ProcessorStepRegistry
from lerobot.processor.converters import batch_to_transition, transition_to_batch
from safetensors.torch import load

from vla_eval.checkpoints.files import unreadable
from vla_eval.checkpoints.saved_processor import SavedStep, check_paths, read_saved_processor
from vla_eval.errors import CheckpointError
from vla_eval.strict.json_fields import FETCH_AGAIN

PROCESSOR_MODULES = re.compile(
    r"lerobot\.processor(\.\w+)?|lerobot\.policies\.\w+\.processor_\w+"
    r"|vla_eval\.models\.\w+\.processor_\w+",
    re.ASCII,
)
"""Modules of lerobot, and of ours, whose steps a checkpoint may name by their import path."""
PLUGIN_MODULES = re.compile(r"(?P<package>lerobot_\w+)(\.\w+)*?\.processor\w*", re.ASCII)
"""The same of installed packages of such a name, which lerobot itself takes for its plug-ins."""
NOT_OF_A_POLICY = "lerobot.processor.hil_processor"
"""Steps for robots with a person beside them; one of them loads another model."""

Overrides = Mapping[str, Mapping[str, Any]]


def resolve_step(step: SavedStep) -> type[Any]:
    """Return the class of a step of lerobot's, of a plug-in's, or of ours; nothing is called."""
    if step.registry_name is not None:
        found = ProcessorStepRegistry._registry.get(step.registry_name)
        if found is None:
            raise CheckpointError(
                f"{step.where}: expected a processor step that is registered, found "
                f"{step.registry_name!r:.100}. Install the package that it is from (`lerobot_policy_…`), or "
                "the lerobot that wrote the checkpoint."
            )
    else:
        found = _imported(step)
    if not _is_step(found) or found.__module__ == NOT_OF_A_POLICY:
        raise _refused(step, "which is not a step of a policy's processor")
    return found  # type: ignore[no-any-return]  # lerobot is untyped


def load_processor(
    path: Path,
    *,
    overrides: Overrides,
    to_transition: Callable[[Any], Any] | None = None,
    to_output: Callable[[Any], Any] | None = None,
    make: type[Any] = DataProcessorPipeline,
) -> Any:
    """Return the pipeline that a file describes, within its folder; `overrides`, ours, are not checked."""
    saved = read_saved_processor(path)
    classes = [resolve_step(step) for step in saved.steps]  # all of them, before the first is called
    for name in overrides:
        if name not in saved.names():
            raise CheckpointError(
                f"{saved.path}: expected a step '{name}', found {', '.join(saved.names()) or 'none'}. "
                f"{FETCH_AGAIN}"
            )
    for step in saved.steps:
        own = overrides.get(step.name, {})
        kept = {key: value for key, value in step.config.items() if key not in own}
        check_paths(step, kept, path.parent)
    states = [_state(step) for step in saved.steps]
    steps = [
        _made(step, cls, overrides.get(step.name, {})) for step, cls in zip(saved.steps, classes, strict=True)
    ]
    for step, instance, state in zip(saved.steps, steps, states, strict=True):
        if state is not None:
            _give(step, instance, state)
    return make(
        steps=steps,
        name=saved.title,
        to_transition=to_transition or batch_to_transition,
        to_output=to_output or transition_to_batch,
    )


@contextlib.contextmanager
def processors_through_the_door() -> Iterator[None]:
    """Let lerobot's `from_pretrained` of a pipeline be `load_processor` within the context."""

    def from_pretrained(
        cls: type[Any],
        /,
        pretrained_model_name_or_path: str | Path,
        config_filename: str,
        *,
        overrides: Overrides | None = None,
        to_transition: Callable[[Any], Any] | None = None,
        to_output: Callable[[Any], Any] | None = None,
        **_hub: Any,
    ) -> Any:
        return load_processor(
            Path(pretrained_model_name_or_path) / config_filename,
            overrides=overrides or {},
            to_transition=to_transition,
            to_output=to_output,
            make=cls,
        )

    with patch.object(DataProcessorPipeline, "from_pretrained", classmethod(from_pretrained)):
        yield


def _imported(step: SavedStep) -> Any:
    module, _, name = str(step.imported).rpartition(".")
    plugin = PLUGIN_MODULES.fullmatch(module)
    if plugin is not None and not _is_installed(plugin["package"]):
        raise _refused(step, f"and no package '{plugin['package']}' is installed")
    if plugin is None and not PROCESSOR_MODULES.fullmatch(module):
        raise _refused(step, "which is in no module of processors of lerobot's, or of a lerobot plugin's")
    try:
        if importlib.util.find_spec(module) is None:
            raise _refused(step, "which is not there")
        loaded = importlib.import_module(module)
    except ImportError as exc:
        raise CheckpointError(
            f"{step.where}: the code {step.imported!r:.100} cannot be imported: {exc}. Install what it "
            "needs, or the version of lerobot that wrote the checkpoint."
        ) from exc
    found = vars(loaded).get(name)
    if _is_step(found) and not found.__module__.startswith(f"{module.partition('.')[0]}."):
        raise _refused(step, f"which is {found.__module__}'s")
    return found


def _is_step(found: object) -> bool:
    return isinstance(found, type) and issubclass(found, ProcessorStep) and not inspect.isabstract(found)


def _is_installed(package: str) -> bool:
    try:
        importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _refused(step: SavedStep, why: str) -> CheckpointError:
    named = step.registry_name or step.imported
    return CheckpointError(
        f"{step.where}: names the code {named!r:.100}, {why}. It is not run. Expected a processor step that "
        "is registered, or one of lerobot's or of an installed plugin's (`lerobot_policy_…`) processor "
        "modules. If it is yours, register it with ProcessorStepRegistry (docs/security.md)."
    )


def _state(step: SavedStep) -> dict[str, Any] | None:
    if step.state_file is None:
        return None
    try:
        return dict(load(step.state_file.read_bytes()))
    except Exception as exc:  # safetensors raises a class of its own that is not public
        raise unreadable(step.state_file, exc) from exc


def _made(step: SavedStep, cls: type[Any], overrides: Mapping[str, Any]) -> Any:
    try:
        return cls(**{**step.config, **overrides})
    except CheckpointError:
        raise
    except Exception as exc:  # whatever a step's constructor raises: tokenizers have their own zoo
        raise CheckpointError(
            f"{step.where}: the step {step.name!r:.100} cannot be made: {exc!s:.1000} Name a local folder "
            "with `tokenizer` in the recipe's args if it is the tokenizer that is missing; nothing is "
            "downloaded unless HF_HUB_OFFLINE=0 is set."
        ) from exc


def _give(step: SavedStep, instance: Any, state: Mapping[str, Any]) -> None:
    try:
        instance.load_state_dict(state)
    except CheckpointError:
        raise
    except Exception as exc:  # as above
        raise CheckpointError(
            f"{step.state_file}: does not fit the step {step.name!r:.100}: {exc!r:.200}. {FETCH_AGAIN}"
        ) from exc
