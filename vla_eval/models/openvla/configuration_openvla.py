"""lerobot's configuration of OpenVLA and OpenVLA-OFT; `docs/openvla.md` explains it."""

from dataclasses import dataclass
from typing import Any  # lerobot is untyped

from lerobot.configs import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from vla_eval.errors import RecipeError
from vla_eval.features import STATE_KEY
from vla_eval.models.openvla.sizes import Head, NetworkOptions, NetworkSizes
from vla_eval.models.shared.images import Augmentation
from vla_eval.models.shared.normalization import Normalization, mask_all_but
from vla_eval.models.shared.ported_config import PromptedConfig
from vla_eval.models.shared.stages import (
    HEAD,
    LANGUAGE,
    PATCHES,
    PROMPT_TOKENS,
    VISION,
    Stage,
    Stages,
    n_images,
)

TYPE = "mikasa_openvla"
HEADS: tuple[Head, ...] = ("l1", "parallel_tokens", "tokens")
# What LoRA trains of OpenVLA, by name. The original says `all-linear` of a transformers model, which spares
# its output embeddings: all linear layers of both vision encoders, the projector and Llama, but not
# `lm_head`. The heads are outside of it and trained in full. For a whole policy `all-linear` would take
# `lm_head` and the heads, too; hence names. Source:
# https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
# vla-scripts/finetune.py#L846-L860. It also puts adapters on blocks whose output is not used; ours are not
# there. Its encoders have one matrix for query, key and value, ours have three: the same rank makes ours
# freer.
_DINO = (
    r"vision\.dino\.encoder\.layer\.\d+\."
    r"(attention\.attention\.(query|key|value)|attention\.output\.dense|mlp\.fc[12])"
)
_SIGLIP = r"vision\.siglip\.encoder\.layers\.\d+\.(self_attn\.(q_proj|k_proj|v_proj|out_proj)|mlp\.fc[12])"
_PROJECTOR = r"projector\.fc[123]"
_LLAMA = r"llm\.model\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
LORA_TARGETS = rf"network\.({_DINO}|{_SIGLIP}|{_PROJECTOR}|{_LLAMA})"
"""Regular expression of the modules that get an adapter; it has to match a whole name."""
FULL_MODULES = ("action_head", "proprio_projector")
"""Modules that are new in fine-tuning and trained in full."""
# Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
# prismatic/vla/datasets/datasets.py#L152-L166
AUGMENTATION = Augmentation(
    crop_area=(0.9, 0.9), brightness=0.2, contrast=(0.8, 1.2), saturation=(0.8, 1.2), hue=0.05
)


@LRSchedulerConfig.register_subclass("mikasa_step_decay")
@dataclass
class StepDecaySchedulerConfig(LRSchedulerConfig):  # type: ignore[misc]  # lerobot is untyped
    """Divides the learning rate by ten once, after `num_decay_steps` (0: never), after a linear warm-up."""

    num_decay_steps: int = 0
    num_warmup_steps: int | None = 0

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Return torch's scheduler."""

        def factor(step: int) -> float:
            warm = min(1.0, (step + 1) / self.num_warmup_steps) if self.num_warmup_steps else 1.0
            return warm * (0.1 if self.num_decay_steps and step >= self.num_decay_steps else 1.0)

        return LambdaLR(optimizer, factor)


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaOpenVLAConfig(PromptedConfig):
    """OpenVLA, or OpenVLA-OFT, as one type; `head` says which.

    It reads all images unless `pictures` names some. `dtype` is that of vision encoders, projector and Llama;
    the continuous head is always float32. As in the original, no chunk begins so late that it goes beyond the
    end of an episode, and AdamW's learning rate is constant but for one division by ten.
    """

    sizes_class = NetworkSizes

    head: str = "l1"  # see `NetworkOptions`
    chunk_size: int = 8  # a part of the model: K = 4 and K = 8 are two trainings
    n_action_steps: int = 8
    use_proprio: bool = False  # read `observation.state` as one more token. The paper does not.
    image_augmentation: bool = True  # change training images at random, crop those of an evaluation alike
    tokenizer_name: str = "openvla/openvla-7b"

    optimizer_grad_clip_norm: float = 0.0
    scheduler_decay_steps: int = 100_000  # 0: never

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("head", HEADS)

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        super().validate_features()
        if self.use_proprio and self.robot_state_feature is None:
            raise RecipeError(f"'{TYPE}' with use_proprio needs {STATE_KEY}.")

    @property
    def image_fields(self) -> tuple[str, ...]:
        """Fields of the images that are read, in order."""
        return tuple(self.pictures) or tuple(self.image_features)

    @property
    def reads_state(self) -> bool:
        """Whether the policy has any use for `observation.state`."""
        return self.use_proprio

    def network_options(self) -> NetworkOptions:
        """Return what the network has in addition to its sizes; needs the dataset's fields."""
        proprio = int(self.robot_state_feature.shape[0]) if self.use_proprio else 0
        head: Any = self.head  # checked in `__post_init__`
        return NetworkOptions(
            head=head, chunk=self.chunk_size, action=int(self.action_feature.shape[0]), proprio=proprio
        )

    def normalizations(self) -> dict[str, Normalization]:
        """Return how fields are normalised; proprioception, if it is read, like the action."""
        fields = super().normalizations()
        if self.use_proprio:
            n_state = int(self.robot_state_feature.shape[0])
            # In an evaluation the original cuts the whole state: experiments/robot/openvla_utils.py#L669.
            fields[STATE_KEY] = Normalization(
                kind="q01_q99", mask=mask_all_but(n_state), clip=True, clip_unmasked=True
            )
        return fields

    def lora_defaults(self) -> dict[str, Any]:
        """Return what LoRA trains unless a recipe says otherwise, in peft's words."""
        full = [
            name
            for name, there in zip(FULL_MODULES, (self.head == "l1", self.use_proprio), strict=True)
            if there
        ]
        return {
            "target_modules": LORA_TARGETS,
            "modules_to_save": full or None,
            "init_lora_weights": "gaussian",
        }

    def get_scheduler_preset(self) -> Any:
        """Return the configuration of the schedule."""
        return StepDecaySchedulerConfig(
            num_decay_steps=self.scheduler_decay_steps, num_warmup_steps=self.scheduler_warmup_steps
        )


DINO_EXTRA = 5  # class token and registers


def network_stages(config: Any) -> Stages:
    """Return the parts of the network, and the tokens of a sample that pass through each."""
    patches, actions = n_images(config) * PATCHES, config.chunk_size * config.action_feature.shape[0]
    return (
        Stage(r"lm_head", 0 if config.head == "l1" else actions, HEAD),
        Stage(r"vision\.dino", patches + n_images(config) * DINO_EXTRA, VISION),
        Stage(r"vision\.|projector", patches, VISION),
        Stage(r"\.llm\.", patches + PROMPT_TOKENS + actions, LANGUAGE),
        Stage(r"action_head", config.chunk_size, HEAD),
    )
