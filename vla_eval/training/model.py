"""The model of a fine-tuning and its processors, made by lerobot's factories and filled strictly by us."""

import contextlib
import importlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple  # lerobot is untyped
from unittest.mock import patch
from urllib.error import URLError

import torch
from lerobot.policies import make_policy, make_pre_post_processors

from vla_eval.checkpoints.backbones import WITHOUT, fetched_backbones
from vla_eval.checkpoints.files import POSTPROCESSOR_FILE, PREPROCESSOR_FILE
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.loading import LoadOptions, begin_from, config_class, fill_policy
from vla_eval.checkpoints.plain_errors import plain_errors, raise_plainly
from vla_eval.checkpoints.processors import tokenizer_overrides
from vla_eval.checkpoints.saved_processor import read_saved_processor
from vla_eval.data.exact_statistics import usable_statistics
from vla_eval.errors import RecipeError, TrainingError
from vla_eval.models.families import family_of
from vla_eval.models.shared.step_names import DECODER_STEP, ENCODER_STEP
from vla_eval.training.job import TrainingJob
from vla_eval.training.policy_config import check_adapters, peft_config

TOKENIZER_STEP = "TokenizerProcessorStep"


class Processors(NamedTuple):
    """The pipelines before and behind the model."""

    before: Any
    after: Any


def make_model(job: TrainingJob, meta: Any) -> Any:
    """Return the policy, which notes its weights, on its device, wrapped by peft where LoRA is trained."""
    config = job.policy
    with _plain_errors(job, "cannot be built"):
        try:
            # A map that renames nothing: the names of the cameras are checked in `policy_config`.
            with fetched_backbones():
                model = make_policy(
                    cfg=config, ds_meta=meta, rename_map=job.recipe.rename_cameras or {"": ""}
                )
        except URLError as exc:
            raise TrainingError(
                f"the policy asks for weights that are not on this machine, and they could not be downloaded "
                f"({exc.reason}). {WITHOUT}"
            ) from exc
        except (ImportError, OSError, RuntimeError) as exc:
            raise_plainly(exc, config)
    config.pretrained_path = job.weights  # only now: lerobot's loaders leave out what does not fit
    if job.weights is not None:
        model = _filled(model, job, job.weights)
    adapters = peft_config(job.recipe, config)
    if adapters is not None and not hasattr(model, "peft_config"):
        model = model.wrap_with_peft(peft_cli_overrides=asdict(adapters))
    check_adapters(model, job.recipe, config)
    return model


def _filled(model: Any, job: TrainingJob, weights: Path) -> Any:
    is_base = job.resume_from is None
    dtype = getattr(job.policy, "dtype", None) if job.base is not None else None
    filled = fill_policy(
        model,
        weights,
        LoadOptions(device=job.policy.device, dtype=dtype),
        may_be_new=getattr(model, "new_in_finetuning", ()) if is_base else (),
    )
    if is_base:
        begin_from(filled, weights)
    return filled.to(job.policy.device)


def make_processors(job: TrainingJob, model: Any, meta: Any) -> Processors:
    """Return the processors: those of the weights' folder, or new ones by the dataset's statistics."""
    stats = usable_statistics(meta.stats, meta.features) if job.resume_from is None else None
    kwargs: dict[str, Any] = {} if stats is None else {"dataset_stats": stats}
    if job.weights is not None:
        kwargs |= _overrides(job, model.config, job.weights, stats)
    with _plain_errors(job, "has no processors"):
        try:
            return Processors(
                *make_pre_post_processors(policy_cfg=job.policy, pretrained_path=job.weights, **kwargs)
            )
        except (ImportError, OSError) as exc:
            raise_plainly(exc, job.policy)


def _plain_errors(job: TrainingJob, what: str) -> contextlib.AbstractContextManager[None]:
    return plain_errors(job.weights or "finetune.policy", job.policy.type, what)


def _overrides(job: TrainingJob, config: Any, folder: Path, stats: Any) -> dict[str, dict[str, Any]]:
    """Return what saved processors are to be given, by step: fields, statistics, device and tokenizers."""
    norm_map = config.normalization_mapping
    every, predicted = {**config.input_features, **config.output_features}, config.output_features
    normalizer = {"features": every, "norm_map": norm_map}
    unnormalizer = {"features": predicted, "norm_map": norm_map}
    if stats is not None:
        normalizer["stats"] = unnormalizer["stats"] = stats
    before: dict[str, Any] = {
        "device_processor": {"device": torch.device(job.device).type},  # of each process its own
        "normalizer_processor": normalizer,
        "rename_observations_processor": {"rename_map": job.recipe.rename_cameras},
    }
    after: dict[str, Any] = {"unnormalizer_processor": unnormalizer}
    if getattr(job.policy, "use_relative_actions", False):
        before["relative_actions_processor"] = {
            "enabled": True,
            "exclude_joints": getattr(job.policy, "relative_exclude_joints", []),
            "action_names": getattr(job.policy, "action_feature_names", None),
        }
        after["absolute_actions_processor"] = {"enabled": True}
    steps = read_saved_processor(folder / PREPROCESSOR_FILE).names()
    before |= tokenizer_overrides(folder, job.policy, steps, tokenizer=job.recipe.tokenizer)
    _address_ours(before, steps, "normalizer_processor", ENCODER_STEP, job.policy)
    steps = read_saved_processor(folder / POSTPROCESSOR_FILE).names()
    _address_ours(after, steps, "unnormalizer_processor", DECODER_STEP, job.policy)
    return {"preprocessor_overrides": before, "postprocessor_overrides": after}


def _address_ours(
    overrides: dict[str, Any], steps: tuple[str, ...], lerobots: str, ours: str, config: Any
) -> None:
    """Give our own normaliser the statistics meant for lerobot's, and the settings of this training."""
    if ours not in steps:
        return
    given = overrides.pop(lerobots)
    if "stats" in given:
        overrides[ours] = {**getattr(config, "encoder_settings", {}), "stats": given["stats"]}


@contextlib.contextmanager
def local_files_only(job: TrainingJob) -> Iterator[None]:
    """Let the policy's processors use the recipe's tokenizer, and nothing run code that a file names."""
    with tokenizer_from(job.recipe.tokenizer, job.policy), no_foreign_code(job.recipe.type):
        yield


@contextlib.contextmanager
def tokenizer_from(folder: str | None, policy: Any) -> Iterator[None]:
    """Replace the tokenizer of a policy's new processors: lerobot has the names of π0's in its code."""
    if folder is None:
        yield
        return
    cls, family = type(policy), family_of(policy.type)
    if family.wraps:  # whose processors it takes
        cls = config_class(family.wraps, where="finetune.type")
    name = cls.__module__.replace("configuration_", "processor_")
    processing: Any = importlib.import_module(name)
    if not Path(folder).is_dir() or not hasattr(processing, TOKENIZER_STEP):
        raise RecipeError(
            f"finetune.tokenizer: expected the folder of a tokenizer and a policy that uses one, found "
            f"{folder} and '{policy.type}'."
        )
    step = getattr(processing, TOKENIZER_STEP)
    with patch.object(
        processing, TOKENIZER_STEP, lambda **fields: step(**{**fields, "tokenizer_name": folder})
    ):
        yield
