"""Read a published OpenVLA, or what the OFT scripts have saved, to make a LeRobot checkpoint of it.

No code of the checkpoint is run. Weights are safetensors; the heads of OFT lie beside them as pickled
tensors (`action_head--50000_checkpoint.pt`), which are read only if that is allowed by name, and then by
torch's reader that builds nothing but tensors.
"""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # JSON and lerobot

import torch
from torch import Tensor

from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.features import ACTION_KEY, STATE_KEY
from vla_eval.models.openvla.configuration_openvla import AUGMENTATION, MikasaOpenVLAConfig
from vla_eval.models.openvla.conversion_options import OpenVLAOptions
from vla_eval.models.openvla.processor_openvla import make_mikasa_openvla_pre_post_processors, prompt_text
from vla_eval.models.openvla.sizes import NetworkSizes
from vla_eval.models.openvla.weight_names import to_ours
from vla_eval.models.shared.normalization import Normalization
from vla_eval.models.shared.original import (
    CONFIG_FILE,
    Original,
    Statistics,
    chosen_statistics,
    read_mask,
    read_safetensors,
    stated_gripper,
    with_features,
)
from vla_eval.models.shared.processor_steps import check_gripper_mask
from vla_eval.strict.json_fields import get_mapping, read_json, wrong_type

STATISTICS_FILE = "dataset_statistics.json"
BACKBONES = {"vision_backbone_id": "dinosiglip-vit-so-224px", "llm_backbone_id": "llama2-7b-pure"}
AUGMENTED_RUN = "image_aug"  # in the names that the original gives to runs with augmentation
KNOWN_INSTRUCTION = "pick"
KNOWN_IDS = (1, 512, 29901, 1724, 3158, 881, 278, 19964, 2125, 304, 5839, 29973, 13, 3744, 29901)
"""What the published tokenizer makes of the prompt of `KNOWN_INSTRUCTION`; from the golden files."""


def read_original(source: Path, options: OpenVLAOptions) -> Original:
    """Read a folder with `config.json`, safetensors and tokenizer of an OpenVLA."""
    described = read_json(source / CONFIG_FILE)
    if not options.sizes:
        for name, expected in BACKBONES.items():
            if described.get(name, expected) != expected:
                raise CheckpointError(f"{source}: {name}: expected {expected}, found {described[name]}.")
    config = _config(source, options)
    statistics = read_statistics(source, described, config, options.unnorm_key)
    fields = None if statistics is None else read_normalizations(source, statistics, config)

    def weights(_policy: Any) -> dict[str, Tensor]:
        read = read_weights(source, options, config.network_sizes())
        return {f"network.{name}": value for name, value in read.items()}

    return Original(
        config=config,
        weights=weights,
        make_processors=lambda: make_mikasa_openvla_pre_post_processors(config, statistics, fields=fields),
        casts=True,
        check_tokenizer=lambda tokenizer: None if options.sizes else _check_tokenizer(tokenizer),
    )


def read_weights(source: Path, options: OpenVLAOptions, sizes: NetworkSizes) -> dict[str, Tensor]:
    """Return the weights of a published checkpoint under our names; pickled ones only if they are allowed."""
    original = read_safetensors(source)
    for name, is_wanted in (
        ("action_head", options.head == "l1"),
        ("proprio_projector", options.proprio > 0),
    ):
        if is_wanted and not any(key.startswith(f"{name}.") for key in original):
            original.update(_pickled(source, name, allowed=options.allow_pickled))
    return to_ours(original, sizes)


def read_statistics(
    source: Path, described: Mapping[str, Any], config: MikasaOpenVLAConfig, unnorm_key: str | None
) -> Statistics | None:
    """Return field -> statistics of the training data; None if there are several and none is chosen."""
    file = source / STATISTICS_FILE
    known = read_json(file) if file.is_file() else get_mapping(described, "norm_stats", where=str(source))
    chosen = chosen_statistics(source, known, unnorm_key)
    if chosen is None:
        return None
    if not isinstance(chosen, dict):
        raise wrong_type(str(source), unnorm_key or "statistics", "a mapping", chosen)
    wanted = {ACTION_KEY: "action", **({STATE_KEY: "proprio"} if config.use_proprio else {})}
    return {ours: get_mapping(chosen, theirs, where=str(source)) for ours, theirs in wanted.items()}


def read_normalizations(
    source: Path, statistics: Statistics, config: MikasaOpenVLAConfig
) -> dict[str, Normalization]:
    """Return how fields are normalised: as ours, with the statistics' masks; a converted gripper is not."""
    fields = {
        key: dataclasses.replace(spec, mask=read_mask(source, key, statistics[key], len(spec.mask)))
        for key, spec in config.normalizations().items()
        if key in statistics
    }
    try:
        check_gripper_mask(fields.get(ACTION_KEY), config.gripper_spec())
    except RecipeError as exc:
        raise CheckpointError(
            f"{source}: expected a mask of the action that leaves the gripper alone, or --gripper maniskill, "
            f"found a normalised gripper encoded as '{config.gripper}'."
        ) from exc
    return fields


def settle_augmentation(source: Path, stated: bool | None) -> bool:
    """Return whether the model was trained with augmentation, and so sees the centre crop in evaluation.

    No file says it, but the original's name of a run does, and it asks for the crop then; else it has to be
    stated. Source:
    https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/vla-scripts/finetune.py#L175
    and experiments/robot/libero/run_libero_eval.py#L137.
    """
    is_named = AUGMENTED_RUN in source.resolve().name
    if stated is None and not is_named:
        raise CheckpointError(
            f"{source}: expected whether it was trained with image augmentation (--image-aug yes or no), "
            f"found nothing, and no '{AUGMENTED_RUN}' in its name. With it, an evaluation shows the middle "
            f"{AUGMENTATION.centre_area:.0%} of each image: yes for the published OpenVLA-OFT, no for the "
            "published openvla-7b."
        )
    if is_named and stated is False:
        raise CheckpointError(
            f"{source}: its name says that it was trained with image augmentation ('{AUGMENTED_RUN}'), "
            "--image-aug says no. Leave the flag out, or name the folder otherwise."
        )
    return is_named or bool(stated)


def _config(source: Path, options: OpenVLAOptions) -> MikasaOpenVLAConfig:
    make: Any = MikasaOpenVLAConfig  # lerobot, whose fields it has, is untyped
    config: MikasaOpenVLAConfig = make(
        head=options.head,
        chunk_size=options.chunk_size,
        n_action_steps=options.chunk_size,
        use_proprio=options.proprio > 0,
        gripper=stated_gripper(source, options.gripper),
        image_augmentation=settle_augmentation(source, options.image_augmentation),
        sizes=options.sizes,
        dtype=options.dtype,
        device="cpu",
        push_to_hub=False,
    )
    cameras = dict.fromkeys(options.pictures, (options.camera_px, options.camera_px))
    return with_features(config, cameras, state=options.proprio)


def _pickled(source: Path, name: str, *, allowed: bool) -> dict[str, Tensor]:
    found = sorted(source.glob(f"{name}--*_checkpoint.pt"), key=_step)
    if not found:
        raise CheckpointError(
            f"{source}: there is no {name} (expected {name}--STEP_checkpoint.pt). A plain OpenVLA has none: "
            "convert it with head `tokens`, and fine-tune from that."
        )
    if not allowed:
        raise CheckpointError(
            f"{found[-1]}: pickled tensors are read only with allow_pickled. Use it for files you trust."
        )
    try:
        tensors = torch.load(found[-1], map_location="cpu", weights_only=True)
    except Exception as exc:  # torch and pickle raise what they like
        raise CheckpointError(
            f"{found[-1]}: expected pickled tensors and nothing else, found what torch refuses to read "
            f"({exc!s:.300}). Fetch the file again, from where you trust it."
        ) from exc
    if not isinstance(tensors, dict) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise CheckpointError(f"{found[-1]}: expected tensors by name, found {type(tensors).__name__}.")
    return {f"{name}.{key.removeprefix('module.')}": value for key, value in tensors.items()}


def _step(file: Path) -> int:
    number = re.search(r"--(\d+)_", file.name)
    return int(number[1]) if number else -1


def _check_tokenizer(tokenizer: Any) -> None:
    found = tuple(tokenizer(prompt_text(KNOWN_INSTRUCTION)).input_ids)
    if found[: len(KNOWN_IDS)] != KNOWN_IDS:
        raise CheckpointError(
            f"the tokenizer makes {found} of a prompt that the model was trained to read as {KNOWN_IDS}. "
            "Another version of transformers may read its files otherwise."
        )
