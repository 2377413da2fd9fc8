"""What one training sample costs: operations, and numbers that are kept for the backward pass.

An estimate from the shapes of the linear layers and the tokens that pass through them; attention scores and
the optimizer's own operations are not counted, convolutions only in small networks. Knows only torch modules.

How many numbers a layer keeps for the backward pass, per token and per input and output of its linear
layers, is in the family's row (`saved_per_linear`). 1.3 was measured on a CPU (torch 2.11, bfloat16, 256
tokens, SDPA) by counting the tensors that autograd saves in one layer of true width: SigLIP-so400m 0.89,
Llama-2-7B 1.20, Gemma-300M 1.32, Gemma-2B 1.34; Gemma 2 with its capped eager attention: 1.91, of which the
scores grow with the number of tokens. Small networks were measured whole, in float32, at the sizes of their
recipes, by `scripts/activation_constants.py`; there, convolutions and attention count like linear layers.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple  # Any: lerobot is untyped

from torch import Tensor, nn

from vla_eval.models.families import family_of
from vla_eval.models.family import imported
from vla_eval.models.shared.stages import EPISODE_STEPS, HEAD, stage_of

LAYER = re.compile(r"(.*\.(?:layers|layer|blocks|block)\.\d+)\.")


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleCost:
    """What a sample costs."""

    inference_operations: float  # of one forward pass, without repeated denoising or decoding
    inference_bytes: float  # what the linear layers of the largest layer read and write in it
    step_operations: float  # of forward and backward pass, what is computed again included
    saved_bytes: float  # kept for the backward pass, and what the largest linear layer reads and writes


class Layer(NamedTuple):
    """A layer that multiplies by a matrix."""

    name: str  # of the module
    weight: Tensor  # its matrix
    # `n_read`, `n_written`: numbers per token, or per place of its output
    n_read: int
    n_written: int


@dataclass(slots=True, kw_only=True)
class Counted:
    """What the layers of a network do with a sample."""

    # `forward`, `step`: operations of a forward pass, and of a training step
    forward: float = 0.0
    step: float = 0.0
    # numbers that the layers which gradients reach read and write, but for those computed again
    saved: float = 0.0
    inputs: float = 0.0  # numbers from which layers are computed again
    # numbers that the largest matrix reads and writes; `largest`: that the largest layer does
    working: float = 0.0
    largest: float = 0.0


def sample_cost(model: Any, config: Any) -> SampleCost | None:
    """Estimate it for a torch module without values and its configuration; None: its tokens are not known."""
    family = family_of(config.type)
    if not family.stages:
        return None
    counted = count(model, config)
    saved = counted.saved * family.saved_per_linear + counted.inputs + counted.working
    alone, through = config.n_passes(EPISODE_STEPS) if hasattr(config, "n_passes") else (0, 1)
    n_bytes = 2 if getattr(config, "dtype", None) == "bfloat16" or getattr(config, "use_amp", False) else 4
    return SampleCost(
        inference_operations=counted.forward,
        inference_bytes=counted.largest * n_bytes,
        step_operations=counted.forward * alone + counted.step * through,
        saved_bytes=saved * n_bytes * through,
    )


def count(model: Any, config: Any) -> Counted:
    """Count operations and numbers of a sample; see `sample_cost`, whose types it knows."""
    family = family_of(config.type)
    stages = imported(family.stages)(config)
    first_trained = min(
        (stage_of(stages, name).order for name, x in model.named_parameters() if x.requires_grad),
        default=HEAD + 1,
    )
    is_recomputed = bool(getattr(config, "gradient_checkpointing", False))
    found = Counted()
    inputs: dict[str, float] = {}
    again: dict[str, float] = {}
    blocks: dict[str, float] = {}
    for layer in _layers(model, every=family.counts_all_layers):
        stage = stage_of(stages, layer.name)
        operations = 2.0 * layer.weight.numel() * stage.tokens
        numbers = float(stage.tokens * (layer.n_read + layer.n_written))
        matched = LAYER.match(layer.name)
        block = layer.name if matched is None else matched[1]
        blocks[block] = blocks.get(block, 0.0) + numbers
        found.forward += operations
        found.step += operations
        found.working = max(found.working, numbers)
        if stage.order < first_trained:
            continue
        found.step += operations * (1 + layer.weight.requires_grad + is_recomputed)
        if is_recomputed and matched is not None:
            inputs.setdefault(block, float(stage.tokens * layer.n_read))
            again[block] = again.get(block, 0.0) + numbers
        else:
            found.saved += numbers
    found.saved += max(again.values(), default=0.0)
    found.inputs = sum(inputs.values())
    found.largest = max(blocks.values(), default=0.0)
    return found


def _layers(model: Any, *, every: bool) -> Iterator[Layer]:
    """Yield the linear layers; if `every`, also convolutions and the projections of torch's attention."""
    for name, module in model.named_modules():
        if isinstance(module, nn.Linear):
            yield Layer(name, module.weight, module.in_features, module.out_features)
        elif every and isinstance(module, nn.Conv1d | nn.Conv2d | nn.ConvTranspose1d):
            n_read = module.in_channels * math.prod(module.stride)
            yield Layer(name, module.weight, n_read, module.out_channels)
        elif every and isinstance(module, nn.GRU | nn.LSTM):
            for key, weight in module.named_parameters():
                if key.startswith("weight"):  # of an input or a state, to all gates
                    yield Layer(name, weight, weight.shape[1], weight.shape[0])
        elif every and isinstance(module, nn.MultiheadAttention) and module.in_proj_weight is not None:
            yield Layer(name, module.in_proj_weight, module.embed_dim, 3 * module.embed_dim)
