"""Folders with the names, layouts and shapes of published checkpoints, at full size, with random weights.

Tokenizers are stand-ins of a few words. Tensors of OpenVLA and SpatialVLA are made while they are written,
so that no memory is needed for them.
"""

import functools
import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any  # JSON, lerobot and tokenizers are untyped

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from tests.models.octo.tiny_octo import GOLDEN as GOLDEN_OCTO
from tests.models.original_names import openvla_names, spatialvla_names
from vla_eval.checkpoints.loading import make_unfilled_policy
from vla_eval.models.families import bases
from vla_eval.models.octo import conversion as octo
from vla_eval.models.octo import flax_names
from vla_eval.models.openvla import conversion as openvla
from vla_eval.models.openvla.conversion_options import OpenVLAOptions
from vla_eval.models.spatialvla import conversion as spatialvla
from vla_eval.models.spatialvla import described as spatialvla_files
from vla_eval.models.spatialvla.action_grid import AXES, uniform_grid
from vla_eval.models.spatialvla.conversion_options import SpatialVLAOptions
from vla_eval.models.spatialvla.sizes import NetworkSizes
from vla_eval.models.weights.file import write_weights
from vla_eval.testing.random_checkpoint import random_parts

SHARD_BYTES = 5_000_000_000  # of a file of a published checkpoint, at most
SEVEN = {name: [value] * 7 for name, value in (("q01", -1.0), ("q99", 1.0), ("mean", 0.0), ("std", 1.0))}
MASK = [True] * 6 + [False]  # the gripper is not normalised
NEWLINE = 108  # of Gemma's vocabulary
WORDS = (
    "<s>",
    "In",
    ":",
    *["What", "action", "should", "the", "robot", "take", "to", "pick", "?"],
    "\n",
    "Out",
    ":",
)
"""What the published tokenizer of OpenVLA splits the prompt of `openvla.KNOWN_INSTRUCTION` into."""


def write_openvla(folder: Path) -> None:
    """Write an OpenVLA of 7.5 billion parameters in shards."""
    config = openvla._config(folder, OpenVLAOptions(gripper="unit_open", image_augmentation=False))
    policy = make_unfilled_policy(config)
    _write_shards(folder, openvla_names(_own(policy)))
    _write_json(
        folder / "config.json",
        {"model_type": "openvla", "norm_stats": {"one": {"action": {**SEVEN, "mask": MASK}}}},
    )
    _write_words(
        folder,
        {"<unk>": 0, "</s>": 2, **dict(zip(WORDS, openvla.KNOWN_IDS, strict=True))},
        bos="<s>",
        eos="</s>",
        pad="</s>",
    )


def write_spatialvla(folder: Path) -> None:
    """Write a SpatialVLA of 4 billion parameters in shards."""
    sizes = NetworkSizes()
    depth, encoder = (_stated(section) for section in spatialvla_files._zoe(sizes))
    _write_json(
        folder / "config.json",
        {
            **_stated(spatialvla_files._top(sizes)),
            "text_config": {**_stated(spatialvla_files._gemma(sizes)), "tie_word_embeddings": True},
            "vision_config": _stated(spatialvla_files._siglip(sizes)),
            "vision_zoe_config": {**depth, "backbone_config": encoder},
        },
    )
    bins: dict[str, dict[str, list[float]]] = {"translation": {}, "rotation": {}}
    for name, edges in zip(AXES, uniform_grid(sizes.n_bins).edges, strict=True):
        bins[spatialvla_files.GRID_PARTS[name]][f"{name}_bins"] = [float(edge) for edge in edges]
    numbers = _stated(spatialvla_files._bins(sizes))
    is_of_axis = {name: name.removesuffix("_bins") in AXES for name in numbers}
    processor = {
        "action_chunk_size": 4,
        "bin_policy": bins,
        "statistics": {"one": {"action": SEVEN}},
        "action_config": {
            **{name: value for name, value in numbers.items() if not is_of_axis[name]},
            "num_bins": {name: value for name, value in numbers.items() if is_of_axis[name]},
        },
    }
    _write_json(folder / spatialvla_files.PROCESSOR_FILE, processor)
    _write_json(folder / spatialvla_files.IMAGES_FILE, _stated(spatialvla_files._images(sizes)))
    policy = make_unfilled_policy(
        spatialvla._config(folder, processor, SpatialVLAOptions(), has_own_head=False)
    )
    _write_shards(folder, spatialvla_names(_own(policy)))
    words = {"<pad>": 0, "<eos>": 1, "<bos>": 2, "<unk>": 3, "\n": NEWLINE}
    _write_words(folder, words, bos="<bos>", eos="<eos>", pad="<pad>")


def write_octo(size: str, folder: Path) -> None:
    """Write an Octo in flax's msgpack; its configuration is known by its size."""
    fields = {**bases()[f"octo_{size}"].fields, "tokenizer_name": "bytes", "gripper_encoding": "unit_open"}
    config = octo.octo_config(fields)
    ours: dict[str, Tensor] = make_unfilled_policy(config).state_dict()
    statistics = {"action": {"mean": [0.0] * 7, "std": [1.0] * 7, "max": [1.0] * 7}}
    _write_json(folder / "dataset_statistics.json", statistics)
    keys = {
        key
        for key in _octo_keys(max(config.layers, config.t5_sizes.layers))
        if (rule := flax_names._rule(key)) is not None and rule.name in ours
    }
    with (folder / "checkpoint").open("wb") as file:
        _pack_map(file.write, _tree(keys), lambda key: _of_flax(key, ours, config.heads))


def _octo_keys(n_blocks: int) -> Iterator[str]:
    """Yield the original's names: those of the golden file, for more blocks; some may be too many."""
    for key in load_file(GOLDEN_OCTO / "weights.safetensors"):
        number = re.search(r"(?<=encoderblock_)\d+|(?<=MLPResNetBlock_)\d+|(?<=encoder\.block\.)\d+", key)
        if number is None or number[0] == "0":
            for index in range(n_blocks if number else 1):
                yield key if number is None else f"{key[: number.start()]}{index}{key[number.end() :]}"


def _of_flax(key: str, ours: Mapping[str, Tensor], heads: int) -> np.ndarray:
    rule = flax_names._rule(key)
    assert rule is not None
    back: dict[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]] = {
        flax_names._same: lambda x: x,
        flax_names._dense: lambda x: x.T,
        flax_names._convolution: lambda x: x.permute(2, 3, 1, 0),
        flax_names._heads_out: lambda x: x.T.unflatten(1, (heads, -1)),
        flax_names._heads_in: lambda x: x.T.unflatten(0, (heads, -1)),
        flax_names._flat: lambda x: x.unflatten(0, (heads, -1)),
    }
    values = torch.cat([part.reshape(-1) for part in random_parts(ours, rule.name)])
    made: np.ndarray = back[rule.change](values.reshape(ours[rule.name].shape)).contiguous().numpy()
    return made


def _tree(keys: set[str]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key in sorted(keys):
        *folders, last = key.split(".")
        functools.reduce(lambda inner, name: inner.setdefault(name, {}), folders, tree)[last] = key
    return tree


def _pack_map(
    write: Callable[[bytes], object], tree: Mapping[str, Any], array_of: Callable[[str], np.ndarray]
) -> None:
    """Write msgpack with the longest form of each type; arrays as flax's extension 1."""
    write(b"\xdf" + struct.pack(">I", len(tree)))
    for name, value in tree.items():
        write(_packed_text(name))
        if isinstance(value, dict):
            _pack_map(write, value, array_of)
            continue
        array = array_of(value)
        shape = b"".join(b"\xd3" + struct.pack(">q", n) for n in array.shape)
        described = b"\xdd" + struct.pack(">I", 3) + b"\xdd" + struct.pack(">I", array.ndim) + shape
        described += _packed_text(array.dtype.name) + b"\xc6" + struct.pack(">I", array.nbytes)
        write(b"\xc9" + struct.pack(">I", len(described) + array.nbytes) + b"\x01" + described)
        write(array.tobytes())


def _packed_text(text: str) -> bytes:
    return b"\xdb" + struct.pack(">I", len(text)) + text.encode()


def _own(policy: Any) -> dict[str, Tensor]:
    return {name.removeprefix("network."): x for name, x in policy.state_dict(keep_vars=True).items()}


def _write_shards(folder: Path, weights: Mapping[str, Tensor]) -> None:
    sizes = {name: x.numel() * x.element_size() for name, x in weights.items()}
    shards: list[list[str]] = [[]]
    for name in weights:
        if shards[-1] and sum(sizes[other] for other in shards[-1]) + sizes[name] > SHARD_BYTES:
            shards.append([])
        shards[-1].append(name)
    for index, names in enumerate(shards, start=1):
        path = folder / f"model-{index:05}-of-{len(shards):05}.safetensors"
        write_weights(path, {name: weights[name] for name in names}, functools.partial(random_parts, weights))


def _stated(section: Any) -> dict[str, Any]:
    return {name: field.ours for name, field in section.fields.items()}


def _write_json(path: Path, data: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(data), encoding="utf-8")


def _write_words(folder: Path, words: Mapping[str, int], *, bos: str, eos: str, pad: str) -> None:
    """Write a tokenizer to which all but these words are unknown."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    tokenizer: Any = Tokenizer(models.WordLevel(dict(words), "<unk>"))
    splits: list[Any] = [pre_tokenizers.Split(" ", "removed"), pre_tokenizers.Split("\n", "isolated")]
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([*splits, pre_tokenizers.Punctuation("isolated")])
    template = processors.TemplateProcessing(single=f"{bos} $A", special_tokens=[(bos, words[bos])])
    tokenizer.post_processor = template
    make: Any = PreTrainedTokenizerFast
    special = {"unk_token": "<unk>", "bos_token": bos, "eos_token": eos, "pad_token": pad}
    make(tokenizer_object=tokenizer, **special).save_pretrained(str(folder))
