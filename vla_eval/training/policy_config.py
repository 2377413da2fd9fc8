"""From a recipe and a dataset to lerobot's configuration of a policy. Knows nothing of the loop."""

import copy
import dataclasses
import importlib
import inspect
from pathlib import Path
from typing import Any, NamedTuple  # lerobot is untyped

import draccus
import numpy as np
import torch
from lerobot.configs.default import PeftConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class
from lerobot.transforms import ImageTransforms, ImageTransformsConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from vla_eval.checkpoints.config_check import check_config
from vla_eval.checkpoints.files import CONFIG_FILE, POSTPROCESSOR_FILE, PREPROCESSOR_FILE, read_json
from vla_eval.checkpoints.foreign_code import only_data
from vla_eval.checkpoints.loading import asked_for, with_local_files
from vla_eval.checkpoints.plain_errors import plain_errors, raise_plainly
from vla_eval.checkpoints.saved_processor import read_saved_processor, refuse_built_in_normalization
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.data.exact_statistics import usable_statistics
from vla_eval.data.opening import OpenDataset
from vla_eval.errors import (
    CheckpointError,
    RecipeError,
    SpecMismatchError,
    VlaEvalError,
    check_names,
    did_you_mean,
)
from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY, STATE_KEY
from vla_eval.models.families import family_of
from vla_eval.models.weights.trainable import check_lora

PADDING_KEYS = (ACTION_PADDING_KEY, "ACTION_PADDING_KEY")  # as lerobot's code writes it, as ours does


class UsedFrames(NamedTuple):
    """How many frames of a dataset a chunk can begin at, of how many."""

    n_used: int
    n_frames: int


def asked_policy(recipe: FinetuneRecipe, cls: Any, base: Path | None, *, device: str) -> Any:
    """Return lerobot's configuration, of this class, that a recipe asks for on top of its base's."""
    known = [field.name for field in dataclasses.fields(cls)]
    check_names("field", recipe.policy, known, where=f"finetune.policy ({recipe.type})")
    data: dict[str, Any] = {}
    if base is not None:
        of_this_base_alone = getattr(cls, "not_of_base", ())
        of_base = _base_config(recipe, cls, base)
        data = {key: value for key, value in of_base.items() if key not in of_this_base_alone}
    if recipe.tokenizer is not None and "text_tokenizer_name" in known:
        data["text_tokenizer_name"] = recipe.tokenizer  # π0-FAST itself loads it, too
    data.update(recipe.policy, device=device, push_to_hub=False)
    return decoded_policy(cls, data, recipe.type)


def decoded_policy(cls: Any, data: dict[str, Any], kind: str) -> Any:
    """Return fields of a policy as lerobot's configuration of this class."""
    try:
        with only_data():  # some configurations open the backbone that they name
            return draccus.decode(cls, data)
    except CheckpointError:
        raise
    except OSError as exc:  # of a backbone that is not here
        raise_plainly(exc, asked_for(cls, kind, data))
    except Exception as exc:  # draccus and the policies raise what they like
        raise RecipeError(
            f"finetune.policy: not a configuration of '{kind}': {exc} {exc.__cause__ or ''}"
        ) from exc


def fit_to_dataset(config: Any, recipe: FinetuneRecipe, dataset: OpenDataset) -> None:
    """Give a configuration the dataset's fields, and what the policy computes from its numbers."""
    with plain_errors(recipe.base_checkpoint or "finetune.policy", recipe.type, "does not fit the dataset"):
        _set_features(config, recipe, dataset)
        if hasattr(config, "fit_to_control_mode"):
            config.fit_to_control_mode(dataset.facts.control_mode)
        if hasattr(config, "window_steps"):
            # The history of a policy with a memory reaches back to the beginning of every episode.
            longest = max(dataset.lengths)
            if config.window_steps is None:
                config.window_steps = longest
            if config.window_steps < longest:
                raise SpecMismatchError(
                    f"finetune.policy.window_steps is {config.window_steps}; expected at least the length of "
                    f"the longest episode of {dataset.name}, {longest} frames: a memory must begin where the "
                    f"episode does. Leave the field out."
                )
        try:
            copy.deepcopy(config).validate_features()  # a copy: some policies add fields to themselves
        except VlaEvalError:
            raise  # ours say what to do
        except Exception as exc:  # the policies raise what they like
            raise SpecMismatchError(f"{dataset.root} does not fit the policy: {exc}") from exc
        if hasattr(config, "fit_to_actions"):
            actions = torch.from_numpy(dataset.columns_used[ACTION_KEY].astype(np.float32))
            statistics = usable_statistics(dataset.meta.stats, dataset.meta.features)
            config.fit_to_actions(actions, statistics[ACTION_KEY])
        if hasattr(config, "fit_to_rewards"):
            config.fit_to_rewards(dataset.columns_used)
        if not masks_padding(config):  # else it would learn to repeat an episode's last action
            longest = max(config.action_delta_indices)
            if getattr(config, "drop_n_last_frames", None) != longest:  # GR00T computes it
                config.drop_n_last_frames = longest  # the sampler of lerobot's loop reads this


def image_transforms(recipe: FinetuneRecipe) -> ImageTransformsConfig:
    """Return lerobot's configuration of random changes to images in training, or raise `RecipeError`."""
    if recipe.image_transforms is None:
        return ImageTransformsConfig()
    try:
        config = draccus.decode(ImageTransformsConfig, {**recipe.image_transforms, "enable": True})
        ImageTransforms(config)
    except Exception as exc:  # draccus, lerobot and torchvision raise what they like
        raise RecipeError(f"finetune.image_transforms: {exc}") from exc
    return config


def masks_padding(config: Any) -> bool:
    """Whether the policy leaves actions beyond the end out of its loss, as it or its code says."""
    said = getattr(config, "masks_padding", None)
    if said is not None:
        return bool(said)
    name = type(config).__module__.replace("configuration_", "modeling_")
    code = inspect.getsource(importlib.import_module(name))
    if not any(key in code for key in PADDING_KEYS):
        return False
    return bool(getattr(config, "do_mask_loss_for_padding", True))


def used_frames(config: Any, dataset: OpenDataset) -> UsedFrames:
    """Return the number of frames that are trained on."""
    dropped = getattr(config, "drop_n_last_frames", 0)
    lengths = dataset.lengths
    used = UsedFrames(sum(max(0, length - dropped) for length in lengths), sum(lengths))
    if used.n_used == 0:
        raise SpecMismatchError(
            f"{dataset.name}: a policy of type '{config.type}' does not mask padded actions, so that chunks "
            f"must lie within an episode; expected episodes of more than {dropped} frames, found at most "
            f"{max(lengths)}. Lower chunk_size in the recipe."
        )
    return used


def _base_config(recipe: FinetuneRecipe, cls: Any, folder: Path) -> dict[str, Any]:
    refuse_built_in_normalization(folder)
    for name in (PREPROCESSOR_FILE, POSTPROCESSOR_FILE):  # their steps are kept, their statistics replaced
        read_saved_processor(folder / name)
    data = read_json(folder / CONFIG_FILE)
    kind = data.pop("type", None)
    expected = dict.fromkeys((family_of(recipe.type).lerobot_type, recipe.type))
    if kind not in expected:
        raise RecipeError(
            f"finetune.base_checkpoint: {recipe.base_checkpoint} holds a '{kind}', expected a "
            f"{' or a '.join(repr(one) for one in expected)}."
        )
    data = with_local_files(data, folder, tokenizer=recipe.tokenizer)
    check_config(cls, data, where=str(folder / CONFIG_FILE))
    return {**data, "use_peft": False, "pretrained_path": None}


def _set_features(config: Any, recipe: FinetuneRecipe, dataset: OpenDataset) -> None:
    """Let the policy expect just what the dataset has, under the base's names."""
    cameras = dataset.cameras
    for field in recipe.rename_cameras:
        if field not in cameras:
            raise SpecMismatchError(
                f"finetune.rename_cameras: the dataset has no image '{field}' (it has: "
                f"{', '.join(cameras)}).{did_you_mean(field, cameras)}"
            )
    features = dataset_to_policy_features(dataset.meta.features)
    inputs = {recipe.rename_cameras.get(field, field): features[field] for field in cameras}
    if recipe.base_checkpoint is not None:
        absent = [key for key in inputs if key not in config.image_features]
        if absent:
            raise SpecMismatchError(
                f"finetune.base_checkpoint was trained with the images {', '.join(config.image_features)}; "
                f"the dataset's would be called {', '.join(inputs)}. Give them the base's names with "
                f"finetune.rename_cameras, for example {{{absent[0]}: {next(iter(config.image_features))}}}."
            )
    state = {STATE_KEY: features[STATE_KEY]} if getattr(config, "reads_state", True) else {}
    config.input_features = {**inputs, **state}
    config.output_features = {ACTION_KEY: features[ACTION_KEY]}


def peft_config(recipe: FinetuneRecipe, policy: Any) -> PeftConfig | None:
    """Return lerobot's settings of the adapters of a policy; None: all weights are trained."""
    lora = recipe.lora
    if lora is None:
        return None
    return PeftConfig(
        r=lora.rank,
        lora_alpha=lora.alpha or lora.rank,
        target_modules=lora.target_modules or family_of(policy.type).lora_targets,
        full_training_modules=list(lora.full_modules) or None,
    )


def check_lora_targets(recipe: FinetuneRecipe, cls: Any) -> None:
    """Raise `RecipeError` where neither recipe nor policy class says which layers get an adapter."""
    if recipe.lora is None or recipe.lora.target_modules is not None:
        return
    if hasattr(cls, "lora_defaults"):
        return
    chosen = get_policy_class(recipe.type)._get_default_peft_targets
    if chosen is PreTrainedPolicy._get_default_peft_targets:
        raise RecipeError(
            f"finetune.lora.target_modules is not set, and '{recipe.type}' does not say itself which layers "
            f"get an adapter. Write a regular expression of whole module names, or leave `lora` out."
        )


def check_adapters(model: Any, recipe: FinetuneRecipe, policy: Any) -> None:
    """Raise `TrainingError` if LoRA trains others than the recipe asks for, else the policy's own choice."""
    if recipe.lora is None:
        return
    if getattr(policy, "memory_tokens", 0) and "memory_tokens" not in recipe.lora.full_modules:
        raise RecipeError(
            "finetune.lora: new memory tokens have nothing to adapt. Train them in full: "
            "finetune.lora.full_modules: [memory_tokens]"
        )
    own = policy.lora_defaults() if hasattr(policy, "lora_defaults") else {}
    target = recipe.lora.target_modules or family_of(policy.type).lora_targets or own.get("target_modules")
    if target is not None:
        check_lora(model, target, tuple(recipe.lora.full_modules or own.get("modules_to_save") or ()))
