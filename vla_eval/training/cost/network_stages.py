"""Which parts a network has, and how many tokens or places of a sample pass through each; by type of policy.

Knows configurations, no modules.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple  # Any: lerobot is untyped

from vla_eval.models.sequence.sizes import nature_edges

PATCHES = 256  # of an image of 224 px in patches of 14
SMOLVLM_PATCHES, SMOLVLM_TOKENS = 1024, 64  # of an image of 512 px in patches of 16, and joined 4 × 4
DINO_EXTRA = 5  # class token and registers
ZOE_PATCHES = 577  # of 384 px in patches of 16, and the class token
PROMPT_TOKENS = 40  # of a prompt that is not padded to a fixed length: about those of the paper's tasks
OCTO_FRAME_TOKENS = 337  # docs/octo.md
OCTO_PROMPT_TOKENS = 16
EPISODE_STEPS = 90  # of an episode whose dataset is not there: those of most tasks
VISION, LANGUAGE, EXPERT, HEAD = range(4)


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


def stage_of(stages: tuple[Stage, ...], name: str) -> Stage:
    """Return the part to which a module belongs, by its name."""
    for stage in stages:
        if re.search(stage.pattern, name):
            return stage
    return Stage("", 1, HEAD)


def _n_images(config: Any) -> int:
    read = getattr(config, "image_fields", None)
    return len(config.image_features if read is None else read)


def _pi0(config: Any) -> tuple[Stage, ...]:
    images = _n_images(config) * PATCHES
    own = 0 if config.type.endswith("pi05") else 1  # π0.5 has its state in the prompt
    memory = getattr(config, "memory_tokens", 0)
    return (
        Stage(r"lm_head", 0, EXPERT),
        Stage(r"vision_tower|multi_modal_projector", images, VISION),
        Stage(r"memory_tokens\.", memory, LANGUAGE),
        # One tensor of attention for both: what trains the expert alone keeps the language model's, too.
        Stage(r"paligemma\.", images + config.tokenizer_max_length + memory, EXPERT),
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
    n_images, memory = _n_images(config), getattr(config, "memory_tokens", 0)
    prefix = n_images * SMOLVLM_TOKENS + config.tokenizer_max_length + 1 + memory
    return (
        Stage(r"lm_head", 0, EXPERT),
        Stage(r"memory_tokens\.", memory, LANGUAGE),
        Stage(r"vision_model", n_images * SMOLVLM_PATCHES, VISION),
        Stage(r"connector", n_images * SMOLVLM_TOKENS, VISION),
        Stage(r"state_proj", 1, LANGUAGE),  # its token passes through the language model
        Stage(r"\.vlm\.", prefix, LANGUAGE),
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


def _act(config: Any) -> tuple[Stage, ...]:
    n_images, (_, height, width) = _n_images(config), _image_shape(config)
    own = 2  # the latent and the state
    places = _resnet_places(height, width)
    return (
        *(
            Stage(rf"backbone\.{name}\b", n_images * n, VISION)
            for name, n in zip(("conv1", *(f"layer{level}" for level in range(1, 5))), places, strict=True)
        ),
        Stage(r"encoder_img_feat_input_proj", n_images * places[-1], VISION),
        Stage(r"vae_encoder\.", config.chunk_size + own, VISION),
        Stage(r"vae_encoder_action", config.chunk_size, VISION),
        Stage(r"model\.encoder\.", n_images * places[-1] + own, LANGUAGE),
        Stage(r"model\.decoder\.|action_head", config.chunk_size, HEAD),
    )


def _diffusion(config: Any) -> tuple[Stage, ...]:
    height, width = config.crop_shape or config.resize_shape or _image_shape(config)[1:]
    shared = 1 if config.use_separate_rgb_encoder_per_camera else _n_images(config)
    n_images = config.n_obs_steps * shared
    places, deepest = _resnet_places(height, width), len(config.down_dims) - 1
    levels = [config.horizon >> level for level in range(deepest + 1)]
    return (
        *(
            Stage(rf"backbone\.{index}\b", n_images * n, VISION)
            for index, n in zip((0, 4, 5, 6, 7), places, strict=True)  # conv1 and the four layers
        ),
        Stage(r"rgb_encoder.*\.pool\.", n_images * places[-1], VISION),
        Stage(r"rgb_encoder.*\.out", n_images, VISION),
        Stage(r"cond_encoder|diffusion_step_encoder", 1, EXPERT),
        *(Stage(rf"down_modules\.{level}\.", n, EXPERT) for level, n in enumerate(levels)),
        *(Stage(rf"up_modules\.{deepest - level}\.", n, EXPERT) for level, n in enumerate(levels)),
        Stage(r"mid_modules", levels[-1], EXPERT),
        Stage(r"final_conv", config.horizon, HEAD),
    )


def _memory(config: Any) -> tuple[Stage, ...]:
    n_steps = config.window_steps or EPISODE_STEPS
    n_places = (_image_shape(config)[-1] // config.patch_px) ** 2
    return (
        Stage(r"network\.(eyes|keys)\.", n_steps * n_places, VISION),
        Stage(r"network\.", n_steps, HEAD),
    )


def _sequence(config: Any) -> tuple[Stage, ...]:
    n_steps = config.window_steps or EPISODE_STEPS
    # Decision Transformer reads its window again at every step.
    n_reads = config.context_steps if config.core == "decision_transformer" else 1
    return (
        *_encoder_stages(config, n_steps, nature=config.encoder.startswith("nature")),
        Stage(r"network\.core\.", n_steps * config.tokens_per_step * n_reads, LANGUAGE),
        Stage(r"network\.sentence\.", 1, HEAD),
        Stage(r"network\.", n_steps, HEAD),
    )


def _offline_rl(config: Any) -> tuple[Stage, ...]:
    return (*_encoder_stages(config, 1, nature=True), Stage(r"network\.targets\.", 0, HEAD))


def _encoder_stages(config: Any, n_images: int, *, nature: bool) -> tuple[Stage, ...]:
    """Return the places of plain encoders of images (`models/sequence/encoders.py`)."""
    n_px = _image_shape(config)[-1]
    encoder = r"network\.(?:encoder|encoders\.\d+)\."
    if not nature:
        places = Stage(encoder + r"features\.", n_images * (n_px // 4) ** 2, VISION)
        return (places, Stage(encoder + "reads", n_images, VISION))
    edges = enumerate(nature_edges(n_px))  # a layer of rectified units follows each convolution
    return (
        *(Stage(encoder + rf"{2 * index}\b", n_images * edge**2, VISION) for index, edge in edges),
        Stage(encoder + r"7\b", n_images, VISION),
    )


def _image_shape(config: Any) -> tuple[int, int, int]:
    channels, height, width = next(iter(config.image_features.values())).shape
    return channels, height, width


def _resnet_places(height_px: int, width_px: int) -> list[int]:
    """Return the places of the outputs of ResNet-18's first convolution and of its four layers."""
    return [-(-height_px // step) * -(-width_px // step) for step in (2, 4, 8, 16, 32)]


STAGES: Mapping[str, Callable[[Any], tuple[Stage, ...]]] = {
    "pi0": _pi0,
    "pi05": _pi0,
    "pi0_fast": _pi0_fast,
    "smolvla": _smolvla,
    "mikasa_pi0": _pi0,
    "mikasa_pi05": _pi0,
    "mikasa_smolvla": _smolvla,
    "mikasa_openvla": _openvla,
    "mikasa_spatialvla": _spatialvla,
    "mikasa_octo": _octo,
    "act": _act,
    "diffusion": _diffusion,
    "mikasa_memory": _memory,
    "mikasa_sequence": _sequence,
    "mikasa_offline_rl": _offline_rl,
}
