"""Read an original Octo checkpoint without jax, to make a LeRobot checkpoint of it. Pickles are never read.

Two layouts of parameters are read: a safetensors file whose names are the parameter tree's joined with
".", and flax's msgpack (`checkpoint`, as orbax aggregates it). The layouts of one folder per parameter
(zarr, OCDBT) need tensorstore and are not read; the message says how to export them.

Source of the format: https://github.com/google/flax/blob/v0.10.4/flax/serialization.py (extension 1: an array
as shape, name of its type, bytes).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any  # lerobot, and plain data of JSON and msgpack

import msgpack
import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from vla_eval.errors import CheckpointError, did_you_mean
from vla_eval.features import ACTION_KEY, IMAGE_SHAPE
from vla_eval.models.families import bases
from vla_eval.models.octo.configuration_octo import MikasaOctoConfig
from vla_eval.models.octo.conversion_options import OctoOptions
from vla_eval.models.octo.flax_names import from_flax
from vla_eval.models.octo.processor_octo import make_mikasa_octo_pre_post_processors
from vla_eval.models.shared.original import Original, stated_gripper, with_features
from vla_eval.strict.json_fields import read_json

STATISTICS_FILE = "dataset_statistics.json"
AGGREGATED_FILE = "checkpoint"
ARRAY_EXTENSION = 1
CHUNKED = "__msgpack_chunked_array__"
EXPORT_HINT = (
    "Where jax is installed, export it once: flatten OctoModel.load_pretrained(PATH).params with "
    "flax.traverse_util.flatten_dict(params, sep='.') and write it with safetensors.numpy.save_file."
)


def read_original(source: Path, options: OctoOptions) -> Original:
    """Read the original's folder: parameters and `dataset_statistics.json`."""
    of_size = {} if options.size is None else bases()[f"octo_{options.size}"].fields
    named = {} if options.tokenizer is None else {"tokenizer_name": options.tokenizer}
    encoding = stated_gripper(source, options.gripper)
    config = octo_config({**of_size, **options.fields, **named, "gripper_encoding": encoding})
    statistics = read_statistics(source if source.is_dir() else source.parent, dataset=options.dataset)
    return Original(
        config=config,
        weights=lambda policy: _with_shared(policy, from_flax(read_parameters(source))),
        make_processors=lambda: make_mikasa_octo_pre_post_processors(config, {ACTION_KEY: dict(statistics)}),
    )


def octo_config(fields: dict[str, Any]) -> MikasaOctoConfig:
    """Return the configuration of an Octo that sees our cameras and gives our actions."""
    height, width, _ = IMAGE_SHAPE
    try:
        config = MikasaOctoConfig(device="cpu", push_to_hub=False, **fields)
    except (TypeError, ValueError) as exc:
        raise CheckpointError(f"not a configuration of Octo: {exc}.") from exc
    return with_features(config, dict.fromkeys(config.cameras.values(), (height, width)))


def _with_shared(policy: Any, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Leave out embeddings that newer versions of transformers do not have under a second name."""
    wanted = policy.state_dict()
    return {key: x for key, x in weights.items() if key in wanted or not key.endswith("embed_tokens.weight")}


def read_parameters(folder: Path) -> dict[str, Tensor]:
    """Return the original's parameter tree, flat, from its folder, a step in it, or one file."""
    files = [folder] if folder.is_file() else _parameter_files(folder)
    if len(files) != 1:
        found = ", ".join(str(file) for file in files) or "none"
        raise CheckpointError(
            f"{folder}: expected one file of parameters (*.safetensors or {AGGREGATED_FILE}), found {found}. "
            f"Name one of several. {EXPORT_HINT}"
        )
    (file,) = files
    if file.suffix == ".safetensors":
        try:
            return dict(load_file(file))
        except Exception as exc:  # safetensors raises a class of its own that is not public
            raise CheckpointError(f"{file}: cannot be read as safetensors ({exc}). Fetch it again.") from exc
    tree = unpack(file.read_bytes(), where=str(file))
    if not isinstance(tree, dict):
        raise CheckpointError(f"{file}: expected a tree of parameters, found {type(tree).__name__}.")
    inner = tree.get("params", tree)
    return {key: torch.from_numpy(np.array(values)) for key, values in _flat(inner).items()}


def read_statistics(folder: Path, *, dataset: str | None) -> dict[str, list[float]]:
    """Return the statistics of actions of a dataset, the only one or the named: name -> numbers."""
    data = read_json(folder / STATISTICS_FILE)
    if "action" not in data:
        if dataset is None or dataset not in data:
            hint = did_you_mean(dataset, data) if dataset else ""
            raise CheckpointError(
                f"{folder / STATISTICS_FILE}: holds the statistics of several datasets; name one with "
                f"--dataset-name.{hint} There are: {', '.join(sorted(data))}."
            )
        data = data[dataset]
    action = data["action"]
    return {name: [float(x) for x in values] for name, values in action.items() if isinstance(values, list)}


def _parameter_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise CheckpointError(f"{folder}: no such folder.")
    layouts = [*folder.rglob(".zarray"), *folder.rglob("manifest.ocdbt")]
    if layouts:
        raise CheckpointError(
            f"{folder}: holds a folder per parameter (zarr or OCDBT), which is not read. {EXPORT_HINT}"
        )
    return sorted([*folder.rglob("*.safetensors"), *folder.rglob(AGGREGATED_FILE)])


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{name}."))
        else:
            flat[name] = value
    return flat


def unpack(data: bytes, *, where: str) -> Any:
    """Return what msgpack holds, arrays, which are whole, as numpy's."""
    try:
        value = msgpack.unpackb(data, ext_hook=_array, strict_map_key=False)
    except (ValueError, TypeError, AttributeError) as exc:  # of damage, types and shapes
        raise CheckpointError(
            f"{where}: not flax's msgpack: {exc!s:.200}. Fetch the checkpoint again."
        ) from exc
    if isinstance(value, dict) and any(CHUNKED in key for key in _flat(value)):
        raise CheckpointError(f"{where}: holds arrays in several parts, which are not read. {EXPORT_HINT}")
    return value


def _array(code: int, inner: bytes) -> Any:
    if code != ARRAY_EXTENSION:
        raise ValueError(f"extension {code} is not an array")
    shape, dtype, content = msgpack.unpackb(inner)
    name = dtype.decode() if isinstance(dtype, bytes) else dtype
    return np.frombuffer(content, dtype=np.dtype(name)).reshape(shape)
