"""The parts of a network, and how many tokens or places of a sample pass through each: LeRobot's families.

Ours say it beside their configurations. torch's `FlopCounterMode` cannot replace it: the forward passes of
these policies branch on values, which tensors without memory do not have, and it does not count what is kept
for the backward pass. Knows configurations, no modules.
"""

import re
from typing import Any, NamedTuple  # Any: lerobot is untyped

PATCHES = 256  # of an image of 224 px in patches of 14
SMOLVLM_PATCHES, SMOLVLM_TOKENS = 1024, 64  # of an image of 512 px in patches of 16, and joined 4 × 4
PROMPT_TOKENS = 40  # of a prompt that is not padded to a fixed length: about those of the paper's tasks
EPISODE_STEPS = 90  # of an episode whose dataset is not there: those of most tasks
VISION, LANGUAGE, EXPERT, HEAD = range(4)


class Stage(NamedTuple):
    """Modules whose names match, the tokens of a sample that pass through (0: none), and their order."""

    pattern: str
    tokens: int
    order: int


Stages = tuple[Stage, ...]


def stage_of(stages: Stages, name: str) -> Stage:
    """Return the part to which a module belongs, by its name."""
    for stage in stages:
        if re.search(stage.pattern, name):
            return stage
    return Stage("", 1, HEAD)


def n_images(config: Any) -> int:
    """Return how many images of a frame are read."""
    read = getattr(config, "image_fields", None)
    return len(config.image_features if read is None else read)


def image_shape(config: Any) -> tuple[int, int, int]:
    """Return channels, height and width of an image."""
    channels, height, width = next(iter(config.image_features.values())).shape
    return channels, height, width


def paligemma_with_expert(config: Any, *, state_tokens: int = 1) -> Stages:
    """π0."""
    images, memory = n_images(config) * PATCHES, getattr(config, "memory_tokens", 0)
    return (
        Stage(r"lm_head", 0, EXPERT),
        Stage(r"vision_tower|multi_modal_projector", images, VISION),
        Stage(r"memory_tokens\.", memory, LANGUAGE),
        # One tensor of attention for both: what trains the expert alone keeps the language model's, too.
        Stage(r"paligemma\.", images + config.tokenizer_max_length + memory, EXPERT),
        Stage(r"gemma_expert|action_|time_mlp|state_proj", config.chunk_size + state_tokens, EXPERT),
    )


def paligemma_with_expert_and_state_in_prompt(config: Any) -> Stages:
    """π0.5."""
    return paligemma_with_expert(config, state_tokens=0)


def paligemma_alone(config: Any) -> Stages:
    """π0-FAST."""
    images = n_images(config) * PATCHES
    return (
        Stage(r"lm_head", config.max_action_tokens, HEAD),
        Stage(r"vision_tower|multi_modal_projector", images, VISION),
        Stage(r"paligemma\.", images + config.tokenizer_max_length + config.max_action_tokens, LANGUAGE),
    )


def smolvlm_with_expert(config: Any) -> Stages:
    """SmolVLA."""
    images, memory = n_images(config), getattr(config, "memory_tokens", 0)
    prefix = images * SMOLVLM_TOKENS + config.tokenizer_max_length + 1 + memory
    return (
        Stage(r"lm_head", 0, EXPERT),
        Stage(r"memory_tokens\.", memory, LANGUAGE),
        Stage(r"vision_model", images * SMOLVLM_PATCHES, VISION),
        Stage(r"connector", images * SMOLVLM_TOKENS, VISION),
        Stage(r"state_proj", 1, LANGUAGE),  # its token passes through the language model
        Stage(r"\.vlm\.", prefix, LANGUAGE),
        Stage(r"lm_expert|action_", config.chunk_size, EXPERT),
    )


def resnet_and_transformer(config: Any) -> Stages:
    """ACT."""
    images, (_, height, width) = n_images(config), image_shape(config)
    own = 2  # the latent and the state
    places = _resnet_places(height, width)
    return (
        *(
            Stage(rf"backbone\.{name}\b", images * n, VISION)
            for name, n in zip(("conv1", *(f"layer{level}" for level in range(1, 5))), places, strict=True)
        ),
        Stage(r"encoder_img_feat_input_proj", images * places[-1], VISION),
        Stage(r"vae_encoder\.", config.chunk_size + own, VISION),
        Stage(r"vae_encoder_action", config.chunk_size, VISION),
        Stage(r"model\.encoder\.", images * places[-1] + own, LANGUAGE),
        Stage(r"model\.decoder\.|action_head", config.chunk_size, HEAD),
    )


def resnet_and_unet(config: Any) -> Stages:
    """Diffusion Policy."""
    height, width = config.crop_shape or config.resize_shape or image_shape(config)[1:]
    shared = 1 if config.use_separate_rgb_encoder_per_camera else n_images(config)
    images = config.n_obs_steps * shared
    places, deepest = _resnet_places(height, width), len(config.down_dims) - 1
    levels = [config.horizon >> level for level in range(deepest + 1)]
    return (
        *(
            Stage(rf"backbone\.{index}\b", images * n, VISION)
            for index, n in zip((0, 4, 5, 6, 7), places, strict=True)  # conv1 and the four layers
        ),
        Stage(r"rgb_encoder.*\.pool\.", images * places[-1], VISION),
        Stage(r"rgb_encoder.*\.out", images, VISION),
        Stage(r"cond_encoder|diffusion_step_encoder", 1, EXPERT),
        *(Stage(rf"down_modules\.{level}\.", n, EXPERT) for level, n in enumerate(levels)),
        *(Stage(rf"up_modules\.{deepest - level}\.", n, EXPERT) for level, n in enumerate(levels)),
        Stage(r"mid_modules", levels[-1], EXPERT),
        Stage(r"final_conv", config.horizon, HEAD),
    )


def _resnet_places(height_px: int, width_px: int) -> list[int]:
    """Return the places of the outputs of ResNet-18's first convolution and of its four layers."""
    return [-(-height_px // step) * -(-width_px // step) for step in (2, 4, 8, 16, 32)]
