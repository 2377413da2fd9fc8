"""Names and layouts of the original checkpoint, and what they become here. Knows no file format.

The original's tree is given flat, joined with "."; dense kernels are (in, out), convolutions HWIO,
attention kernels (in, heads, head) and (heads, head, out). Each tensor has to be used, and none may lack.
"""

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from vla_eval.errors import CheckpointError
from vla_eval.models.weights.exact import listed

TRUNK = "octo_transformer."
HEAD = "heads_action.diffusion_model."
BLOCK = TRUNK + r"BlockTransformer_0\.Transformer_0\.encoderblock_(?P<i>\d+)\."
ATTENTION = BLOCK + r"MultiHeadDotProductAttention_0\."
STEM = TRUNK + r"observation_tokenizers_(?P<camera>\w+?)\.SmallStem16_0\."
T5 = TRUNK + r"task_tokenizers_language\.hf_model\."
RESIDUAL = HEAD + r"reverse_network\.MLPResNetBlock_(?P<i>\d+)\."


class _Rule(NamedTuple):
    pattern: str
    name: str
    change: Callable[[Tensor], Tensor]


def _same(x: Tensor) -> Tensor:
    return x


def _dense(x: Tensor) -> Tensor:
    return x.T


def _convolution(x: Tensor) -> Tensor:
    return x.permute(3, 2, 0, 1)


def _heads_out(x: Tensor) -> Tensor:
    return x.flatten(1).T  # (in, heads, head) -> (heads × head, in)


def _heads_in(x: Tensor) -> Tensor:
    return x.flatten(0, 1).T  # (heads, head, out) -> (out, heads × head)


def _kernel(pattern: str, name: str, change: Callable[[Tensor], Tensor] = _dense) -> list[_Rule]:
    weight = _Rule(pattern + r"\.kernel", f"{name}.weight", change)
    return [weight, _Rule(pattern + r"\.bias", f"{name}.bias", _same)]


def _norm(pattern: str, name: str) -> list[_Rule]:
    weight = _Rule(pattern + r"\.scale", f"{name}.weight", _same)
    return [weight, _Rule(pattern + r"\.bias", f"{name}.bias", _same)]


_BLOCKS = r"network.transformer.blocks.\g<i>"
_STEMS = r"network.transformer.stems.\g<camera>"
_HEAD_BLOCKS = r"network.head.blocks.\g<i>"
_RULES: tuple[_Rule, ...] = (
    *_kernel(STEM + r"StdConv_(?P<i>\d)", rf"{_STEMS}.convolutions.\g<i>", _convolution),
    *_norm(STEM + r"GroupNorm_(?P<i>\d)", rf"{_STEMS}.norms.\g<i>"),
    *_kernel(STEM + "embedding", f"{_STEMS}.embedding", _convolution),
    *_kernel(TRUNK + r"obs_(?P<camera>\w+)_projection", r"network.transformer.projections.\g<camera>"),
    _Rule(
        TRUNK + r"obs_(?P<camera>\w+)_pos_embedding", r"network.transformer.image_positions.\g<camera>", _same
    ),
    *_kernel(TRUNK + r"task_language_projection", "network.transformer.language_projection"),
    _Rule(TRUNK + r"task_language_pos_embedding", "network.transformer.language_positions", _same),
    _Rule(TRUNK + r"readout_action_pos_embedding", "network.transformer.readout_positions", _same),
    *(
        rule
        for part in ("query", "key", "value")
        for rule in (
            _Rule(ATTENTION + rf"{part}\.kernel", f"{_BLOCKS}.{part}.weight", _heads_out),
            _Rule(ATTENTION + rf"{part}\.bias", f"{_BLOCKS}.{part}.bias", torch.flatten),
        )
    ),
    *_kernel(ATTENTION + "out", f"{_BLOCKS}.out", _heads_in),
    *_norm(BLOCK + "LayerNorm_0", f"{_BLOCKS}.attention_norm"),
    *_norm(BLOCK + "LayerNorm_1", f"{_BLOCKS}.mlp_norm"),
    *_kernel(BLOCK + r"MlpBlock_0\.Dense_0", f"{_BLOCKS}.fc1"),
    *_kernel(BLOCK + r"MlpBlock_0\.Dense_1", f"{_BLOCKS}.fc2"),
    *_norm(TRUNK + r"BlockTransformer_0\.Transformer_0\.encoder_norm", "network.transformer.norm"),
    _Rule(HEAD + r"time_preprocess\.kernel", "network.head.frequencies", _same),
    *_kernel(HEAD + r"cond_encoder\.Dense_0", "network.head.time_fc1"),
    *_kernel(HEAD + r"cond_encoder\.Dense_1", "network.head.time_fc2"),
    *_kernel(HEAD + r"reverse_network\.Dense_0", "network.head.first"),
    *_kernel(HEAD + r"reverse_network\.Dense_1", "network.head.last"),
    *_norm(RESIDUAL + "LayerNorm_0", f"{_HEAD_BLOCKS}.norm"),
    *_kernel(RESIDUAL + "Dense_0", f"{_HEAD_BLOCKS}.fc1"),
    *_kernel(RESIDUAL + "Dense_1", f"{_HEAD_BLOCKS}.fc2"),
    _Rule(T5 + r"shared\.embedding", "language.shared.weight", _same),
    _Rule(T5 + r"(?P<rest>.+)\.kernel", r"language.\g<rest>.weight", _dense),
    _Rule(T5 + r"(?P<rest>.+)\.embedding", r"language.\g<rest>.weight", _same),
    _Rule(T5 + r"(?P<rest>.+)\.weight", r"language.\g<rest>.weight", _same),
)
_KERNELS = tuple(
    re.compile("[^.]+".join(re.escape(part) for part in re.split(r"\\g<\w+>", rule.name)))
    for rule in _RULES
    if rule.pattern.endswith("kernel") and not rule.pattern.startswith(T5)
)
_COMPILED = tuple((re.compile(rule.pattern), rule) for rule in _RULES)


def from_flax(tree: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the policy's tensors by our names, of the original's flat tree; raise if one is unknown."""
    converted, unknown = {}, []
    for key, values in tree.items():
        rule = _rule(key)
        if rule is None:
            unknown.append(key)
            continue
        converted[rule.name] = rule.change(torch.as_tensor(values)).contiguous()
    if unknown:
        raise CheckpointError(
            f"{len(unknown)} tensors are not of the Octo that is built here (cameras, instruction, diffusion "
            f"head): {listed(unknown)}."
        )
    return converted


def is_kernel(name: str) -> bool:
    """Return whether a parameter of our network is a `kernel` of the original: what its optimizer decays.

    Source: https://github.com/octo-models/octo/blob/241fb3514b7c40957a86d869fecb7c7fc353f540/octo/utils/
    train_utils.py#L314-L317.
    """
    return any(pattern.fullmatch(name) for pattern in _KERNELS)


def _rule(key: str) -> _Rule | None:
    """Return the first rule for a tensor, its name filled in."""
    for pattern, rule in _COMPILED:
        match = pattern.fullmatch(key)
        if match is not None:
            return rule._replace(name=match.expand(rule.name))
    return None
