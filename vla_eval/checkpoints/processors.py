"""What stands before and behind a LeRobot policy: its processors, their tokenizers and statistics."""

import importlib
import importlib.util
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any  # lerobot is untyped

from lerobot.configs import NormalizationMode
from lerobot.policies import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep

from vla_eval.checkpoints.files import (
    ACTION_TOKENIZER_FOLDER,
    POSTPROCESSOR_FILE,
    PREPROCESSOR_FILE,
    TOKENIZER_FOLDER,
    VLM_FOLDER,
)
from vla_eval.checkpoints.foreign_code import only_data
from vla_eval.checkpoints.notes import NEEDED_STATISTICS
from vla_eval.checkpoints.safe_processors import processors_through_the_door
from vla_eval.checkpoints.saved_processor import read_saved_processor
from vla_eval.errors import CheckpointError, VlaEvalError
from vla_eval.models.shared.processor_steps import DecoderStep, EncoderStep

TOKENIZER_STEP, ACTION_TOKENIZER_STEP = "tokenizer_processor", "action_tokenizer_processor"


def load_processors(folder: Path, config: Any, *, tokenizer: str | None) -> tuple[Any, Any]:
    """Return pre- and post-processor as a checkpoint describes them; `tokenizer`: instead of its own."""
    register_steps(type(config))
    files = (PREPROCESSOR_FILE, POSTPROCESSOR_FILE)
    before, after = (read_saved_processor(folder / name).names() for name in files)
    here: dict[str, Any] = {"device": config.device}
    devices = ("device_processor", "normalizer_processor")
    overrides: dict[str, Any] = {name: here for name in devices if name in before}
    if tokenizer is not None and TOKENIZER_STEP not in before:
        raise CheckpointError(f"{folder}: `tokenizer` is given, but this policy's preprocessor has none.")
    overrides.update(tokenizer_overrides(folder, config, before, tokenizer=tokenizer))
    # The postprocessor ends with a step of the same name that brings actions to the CPU: left alone.
    after_overrides = {name: here for name in ("unnormalizer_processor",) if name in after}
    try:
        with only_data(), processors_through_the_door():
            return make_pre_post_processors(  # type: ignore[no-any-return]
                config,
                pretrained_path=str(folder),
                preprocessor_overrides=overrides,
                postprocessor_overrides=after_overrides,
            )
    except VlaEvalError:
        raise  # ours say what to do
    except Exception as exc:  # whatever a family does with its processors once they are made
        raise CheckpointError(f"{folder}: the processors cannot be made: {exc}") from exc


def register_steps(cls: type) -> None:
    """Import a policy's processor steps; lerobot does so for a training only."""
    module = cls.__module__
    name = module.replace("configuration_", "processor_")
    if name != module and importlib.util.find_spec(name) is not None:
        importlib.import_module(name)


def tokenizer_overrides(
    folder: Path, config: Any, steps: Sequence[str], *, tokenizer: str | None
) -> dict[str, dict[str, Any]]:
    """Return the settings of a preprocessor's steps that make tokens; `tokenizer`: see `load_processors`."""
    overrides: dict[str, dict[str, Any]] = {}
    own = _tokenizer(folder, tokenizer)
    if TOKENIZER_STEP in steps and own is not None:
        overrides[TOKENIZER_STEP] = {"tokenizer_name": own}
    if ACTION_TOKENIZER_STEP in steps:  # lerobot saves neither the text tokenizer nor the skipped tokens
        overrides[ACTION_TOKENIZER_STEP] = {
            "action_tokenizer_name": config.action_tokenizer_name,
            "paligemma_tokenizer_name": config.text_tokenizer_name,
            "fast_skip_tokens": config.fast_skip_tokens,
            "max_action_tokens": config.max_action_tokens,
        }
    return overrides


def own_tokenizers(folder: Path, tokenizer: str | None) -> dict[str, str]:
    """Return what a policy itself loads, by its configuration's fields: tokenizers, SmolVLA's description."""
    found = {"text_tokenizer_name": _tokenizer(folder, tokenizer)}
    vlm, actions = folder / VLM_FOLDER, folder / ACTION_TOKENIZER_FOLDER
    if vlm.is_dir():
        found["vlm_model_name"] = str(vlm)
    if actions.is_dir():
        found["action_tokenizer_name"] = str(actions)
    return {name: value for name, value in found.items() if value is not None}


def _tokenizer(folder: Path, named: str | None) -> str | None:
    if named is not None:
        if not Path(named).is_dir():
            raise CheckpointError(f"tokenizer: expected a folder, found nothing at {named}.")
        return named
    for own in (folder / TOKENIZER_FOLDER, folder / VLM_FOLDER):
        if own.is_dir():
            return str(own)
    return None


def save_tokenizers(preprocessor: Any, folder: Path) -> None:
    """Keep the tokenizers beside the weights: the names they were loaded by may mean nothing elsewhere."""
    for step in preprocessor.steps:
        tokenizer = getattr(step, "input_tokenizer", None)
        if tokenizer is not None:
            tokenizer.save_pretrained(str(folder / TOKENIZER_FOLDER))
        action_tokenizer: Any = getattr(step, "action_tokenizer", None)
        if hasattr(action_tokenizer, "save_pretrained"):
            action_tokenizer.save_pretrained(folder / ACTION_TOKENIZER_FOLDER)


def save_vlm_files(config: Any, folder: Path) -> None:
    """Keep SmolVLA's description of its language model and its processor beside the weights, as above."""
    source = Path(str(getattr(config, "vlm_model_name", "")))
    if source.name == VLM_FOLDER and source.is_dir():
        shutil.copytree(source, folder / VLM_FOLDER, dirs_exist_ok=True)


def check_statistics(folder: Path, preprocessor: Any, postprocessor: Any) -> None:
    """Raise unless all that is normalised has statistics: lerobot passes on unchanged what has none."""
    missing = []
    for step in (*preprocessor.steps, *postprocessor.steps):
        if isinstance(step, EncoderStep | DecoderStep):
            missing += step.missing_statistics()
        if not isinstance(step, NormalizerProcessorStep | UnnormalizerProcessorStep):
            continue
        for key, feature in step.features.items():
            mode = step.norm_map.get(feature.type, NormalizationMode.IDENTITY)
            have = (step.stats or {}).get(key, {})
            missing += [f"{key}.{name}" for name in NEEDED_STATISTICS.get(mode, ()) if name not in have]
    if missing:
        shown = ", ".join(dict.fromkeys(missing))
        raise CheckpointError(
            f"{folder}: the checkpoint has no statistics for {shown}; lerobot would skip that normalisation "
            f"without a word. Fine-tune it on a dataset, or fetch the complete checkpoint."
        )
