"""What one training sample costs: operations, and numbers that are kept for the backward pass.

An estimate from the shapes of the linear layers and the tokens that pass through them; attention scores,
convolutions and the optimizer's own operations are not counted. Knows only torch modules.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple  # Any: lerobot is untyped

from torch import nn

SAVED_PER_LINEAR = 1.3
"""Numbers that a layer keeps for the backward pass, per token and per input and output of its linear layers.

Measured on a CPU (torch 2.11, bfloat16, 256 tokens, SDPA) by counting the tensors that autograd saves in
one layer of true width: SigLIP-so400m 0.89, Llama-2-7B 1.20, Gemma-300M 1.32, Gemma-2B 1.34. Gemma 2 with
its capped eager attention: 1.91, of which the scores grow with the number of tokens.
"""
SAVED_PER_LINEAR_OF = {"mikasa_spatialvla": 1.9}
PATCHES = 256  # of an image of 224 px in patches of 14
SMOLVLM_PATCHES, SMOLVLM_TOKENS = 1024, 64  # of an image of 512 px in patches of 16, and joined 4 × 4
DINO_EXTRA = 5  # class token and registers
ZOE_PATCHES = 577  # of 384 px in patches of 16, and the class token
PROMPT_TOKENS = 40  # of a prompt that is not padded to a fixed length: about those of the paper's tasks
OCTO_FRAME_TOKENS = 337  # docs/octo.md
OCTO_PROMPT_TOKENS = 16
VISION, LANGUAGE, EXPERT, HEAD = range(4)
LAYER = re.compile(r"(.*\.(?:layers|layer|blocks|block)\.\d+)\.")


class Stage(NamedTuple):
    """A part of a network.

    Attributes:
        pattern: of the names of its modules.
        tokens: of a sample that pass through it; 0: it is not used.
        order: parts of lower order are computed before it.
    """

    pattern: str
    tokens: int
    order: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleCost:
    """What a sample costs.

    Attributes:
        inference_operations: of one forward pass, without repeated denoising or decoding.
        step_operations: of forward and backward pass, what is computed again included.
        saved_bytes: kept for the backward pass, and what the largest linear layer reads and writes.
    """

    inference_operations: float
    step_operations: float
    saved_bytes: float


def sample_cost(model: Any, config: Any) -> SampleCost | None:
    """Estimate it; None for a type of policy whose tokens are not known here.

    Args:
        model: a torch module of lerobot's; its weights need no memory.
        config: of the policy.
    """
    if config.type not in STAGES:
        return None
    stages = STAGES[config.type](config)
    first_trained = min(
        (_stage(stages, name).order for name, x in model.named_parameters() if x.requires_grad),
        default=HEAD + 1,
    )
    is_recomputed = bool(getattr(config, "gradient_checkpointing", False))
    forward = step = saved = working = 0.0
    inputs: dict[str, float] = {}
    of_layer: dict[str, float] = {}
    for name, linear in _linears(model):
        stage = _stage(stages, name)
        operations = 2.0 * linear.in_features * linear.out_features * stage.tokens
        forward += operations
        step += operations
        numbers = float(stage.tokens * (linear.in_features + linear.out_features))
        working = max(working, numbers)
        if stage.order < first_trained:
            continue
        step += operations * (1 + linear.weight.requires_grad + is_recomputed)
        layer = LAYER.match(name)
        if is_recomputed and layer is not None:
            inputs.setdefault(layer[1], float(stage.tokens * linear.in_features))
            of_layer[layer[1]] = of_layer.get(layer[1], 0.0) + numbers
        else:
            saved += numbers
    saved += max(of_layer.values(), default=0.0)
    saved *= SAVED_PER_LINEAR_OF.get(config.type, SAVED_PER_LINEAR)
    saved += sum(inputs.values()) + working
    n_bytes = 2 if getattr(config, "dtype", None) == "bfloat16" or getattr(config, "use_amp", False) else 4
    return SampleCost(inference_operations=forward, step_operations=step, saved_bytes=saved * n_bytes)


def _linears(model: Any) -> Iterator[tuple[str, nn.Linear]]:
    for name, module in model.named_modules():
        if isinstance(module, nn.Linear):
            yield name, module


def _stage(stages: tuple[Stage, ...], name: str) -> Stage:
    for stage in stages:
        if re.search(stage.pattern, name):
            return stage
    return Stage("", 1, HEAD)


def _n_images(config: Any) -> int:
    read = getattr(config, "image_fields", None)
    return len(config.image_features if read is None else read)


def _pi0(config: Any) -> tuple[Stage, ...]:
    images = _n_images(config) * PATCHES
    own = 1 if config.type == "pi0" else 0  # π0.5 has its state in the prompt
    return (
        Stage(r"lm_head", 0, EXPERT),
        Stage(r"vision_tower|multi_modal_projector", images, VISION),
        Stage(r"paligemma\.", images + config.tokenizer_max_length, LANGUAGE),
        Stage(r"gemma_expert|action_|time_mlp|state_proj", config.chunk_size + own, EXPERT),
    )


def _pi0_fast(config: Any) -> tuple[Stage, ...]:
    images = _n_images(config) * PATCHES
    return (
        Stage(r"lm_head", config.max_action_tokens, HEAD),
        Stage(r"vision_tower|multi_modal_projector", images, VISION),
        Stage(r"paligemma\.", images + config.tokenizer_max_length + config.max_action_tokens, LANGUAGE),
    )


def _smolvla(config: Any) -> tuple[Stage, ...]:
    n_images = _n_images(config)
    return (
        Stage(r"lm_head", 0, EXPERT),
        Stage(r"vision_model", n_images * SMOLVLM_PATCHES, VISION),
        Stage(r"connector", n_images * SMOLVLM_TOKENS, VISION),
        Stage(r"state_proj", 1, LANGUAGE),  # its token passes through the language model
        Stage(r"\.vlm\.", n_images * SMOLVLM_TOKENS + config.tokenizer_max_length + 1, LANGUAGE),
        Stage(r"lm_expert|action_", config.chunk_size, EXPERT),
    )


def _openvla(config: Any) -> tuple[Stage, ...]:
    n_images = _n_images(config)
    actions = config.chunk_size * config.action_feature.shape[0]
    return (
        Stage(r"lm_head", 0 if config.head == "l1" else actions, HEAD),
        Stage(r"vision\.dino", n_images * (PATCHES + DINO_EXTRA), VISION),
        Stage(r"vision\.|projector", n_images * PATCHES, VISION),
        Stage(r"\.llm\.", n_images * PATCHES + PROMPT_TOKENS + actions, LANGUAGE),
        Stage(r"action_head", config.chunk_size, HEAD),
    )


def _spatialvla(config: Any) -> tuple[Stage, ...]:
    n_images, actions = _n_images(config), 3 * config.chunk_size
    return (
        Stage(r"lm_head", actions, HEAD),
        Stage(r"depth\.", n_images * ZOE_PATCHES, VISION - 1),
        Stage(r"vision|projector|position", n_images * PATCHES, VISION),
        Stage(r"\.llm\.", n_images * PATCHES + PROMPT_TOKENS + actions, LANGUAGE),
    )


def _octo(config: Any) -> tuple[Stage, ...]:
    tokens = OCTO_PROMPT_TOKENS + OCTO_FRAME_TOKENS * config.window
    return (
        Stage(r"language\.", OCTO_PROMPT_TOKENS, VISION - 1),
        Stage(r"head\.", config.window, HEAD),
        Stage(r"transformer\.", tokens, LANGUAGE),
    )


STAGES: Mapping[str, Callable[[Any], tuple[Stage, ...]]] = {
    "pi0": _pi0,
    "pi05": _pi0,
    "pi0_fast": _pi0_fast,
    "smolvla": _smolvla,
    "mikasa_openvla": _openvla,
    "mikasa_spatialvla": _spatialvla,
    "mikasa_octo": _octo,
}
