"""lerobot's configuration of OpenVLA and OpenVLA-OFT; `docs/openvla.md` explains it."""

from dataclasses import dataclass, field
from typing import Any  # lerobot is untyped

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from vla_eval.errors import RecipeError, check_names, unknown_name
from vla_eval.features import ACTION_KEY, STATE_KEY
from vla_eval.policies.openvla.lora import FULL_MODULES, LORA_TARGETS
from vla_eval.policies.openvla.sizes import Head, NetworkOptions, NetworkSizes, network_sizes
from vla_eval.policies.steps.gripper import Gripper
from vla_eval.policies.steps.images import Augmentation
from vla_eval.policies.steps.normalization import Normalization, mask_all_but
from vla_eval.policies.steps.precision import DTYPES

TYPE = "mikasa_openvla"
HEADS: tuple[Head, ...] = ("l1", "parallel_tokens", "tokens")
# Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
# prismatic/vla/datasets/datasets.py#L152-L166
AUGMENTATION = Augmentation(
    crop_area=(0.9, 0.9), brightness=0.2, contrast=(0.8, 1.2), saturation=(0.8, 1.2), hue=0.05
)


@LRSchedulerConfig.register_subclass("mikasa_step_decay")
@dataclass
class StepDecaySchedulerConfig(LRSchedulerConfig):  # type: ignore[misc]  # lerobot is untyped
    """Divides the learning rate by ten once, after so many steps; 0: never.

    Attributes:
        num_decay_steps: so many.
        num_warmup_steps: linear, from nothing.
    """

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
class MikasaOpenVLAConfig(PreTrainedConfig):  # type: ignore[misc]  # lerobot is untyped
    """OpenVLA, or OpenVLA-OFT, as one type: the head tells which.

    Attributes:
        head: see `NetworkOptions`.
        chunk_size: actions of a chunk. A part of the model: K = 4 and K = 8 are two trainings.
        n_action_steps: how many lerobot's own loop executes, the first ones; ours sets its own number.
        pictures: fields of the pictures that are read, in this order; empty: all of the dataset's.
        use_proprio: read `observation.state` as one more token. The paper does not.
        sizes: sizes that differ from the published model's, see `NetworkSizes`.
        dtype: of eyes, projector and Llama: `float32`, `bfloat16`. The continuous head is always float32.
        gradient_checkpointing: recompute activations in the backward pass.
        image_augmentation: change training pictures at random and crop those of an evaluation alike.
        gripper: how the gripper is encoded.
        do_mask_loss_for_padding: leave actions beyond an episode's end out of the loss. False, as the
            original: no chunk begins so late that it has any.
        drop_n_last_frames: set by `__post_init__` for that; lerobot's sampler reads it.
        tokenizer_name: folder or name of the tokenizer; `bytes`: see
            `steps.byte_tokenizer`.
        prompt_max_tokens: a longer prompt is an error.
        optimizer_lr, optimizer_weight_decay, optimizer_grad_clip_norm, scheduler_warmup_steps,
            scheduler_decay_steps: AdamW, constant, divided by ten after `scheduler_decay_steps` (0: never).
    """

    head: str = "l1"
    chunk_size: int = 8
    n_action_steps: int = 8
    pictures: list[str] = field(default_factory=list)
    use_proprio: bool = False
    sizes: dict[str, int] = field(default_factory=dict)
    dtype: str = "bfloat16"
    gradient_checkpointing: bool = False
    image_augmentation: bool = True
    gripper: str = "maniskill"
    do_mask_loss_for_padding: bool = False
    drop_n_last_frames: int = 0
    tokenizer_name: str = "openvla/openvla-7b"
    prompt_max_tokens: int = 256

    optimizer_lr: float = 5e-4
    optimizer_weight_decay: float = 1e-2
    optimizer_grad_clip_norm: float = 0.0
    scheduler_warmup_steps: int = 0
    scheduler_decay_steps: int = 100_000

    # Of lerobot's own normaliser, which this policy does not use: see `normalizations`.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    def __post_init__(self) -> None:
        """Check what can be checked without a dataset."""
        super().__post_init__()
        for name, value, known in (("head", self.head, HEADS), ("dtype", self.dtype, DTYPES)):
            if value not in known:
                raise unknown_name(name, value, known, where=TYPE)
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise RecipeError(
                f"n_action_steps is {self.n_action_steps}, expected 1 to chunk_size ({self.chunk_size})."
            )
        self.network_sizes()
        self.gripper_spec()
        self.drop_n_last_frames = 0 if self.do_mask_loss_for_padding else self.chunk_size - 1

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        if not self.image_features or self.action_feature is None:
            raise RecipeError(f"'{TYPE}' needs pictures and an action.")
        if self.use_proprio and self.robot_state_feature is None:
            raise RecipeError(f"'{TYPE}' with use_proprio needs {STATE_KEY}.")
        check_names("picture", self.pictures, self.image_features, where=f"policy.pictures ({TYPE})")

    @property
    def picture_fields(self) -> tuple[str, ...]:
        """Fields of the pictures that are read, in order."""
        return tuple(self.pictures) or tuple(self.image_features)

    @property
    def reads_state(self) -> bool:
        """Whether the policy has any use for `observation.state`."""
        return self.use_proprio

    def network_sizes(self) -> NetworkSizes:
        """Return the sizes of the network."""
        return network_sizes(self.sizes)

    def network_options(self) -> NetworkOptions:
        """Return what the network has beside its sizes; needs the dataset's fields."""
        proprio = int(self.robot_state_feature.shape[0]) if self.use_proprio else 0
        head: Any = self.head  # checked in `__post_init__`
        return NetworkOptions(
            head=head, chunk=self.chunk_size, action=int(self.action_feature.shape[0]), proprio=proprio
        )

    def gripper_spec(self) -> Gripper:
        """Return how the gripper is encoded."""
        encoding: Any = self.gripper  # `Gripper` checks it
        return Gripper(encoding=encoding)

    def normalizations(self) -> dict[str, Normalization]:
        """Return how fields are normalised: q01 … q99 to [-1, 1], cut there; the gripper stays as it is.

        Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
        prismatic/vla/datasets/rlds/utils/data_utils.py#L52-L90.
        """
        n_dims = int(self.action_feature.shape[0])
        fields = {
            ACTION_KEY: Normalization(kind="q01_q99", mask=mask_all_but(n_dims, left_alone=(-1,)), clip=True)
        }
        if self.use_proprio:
            n_state = int(self.robot_state_feature.shape[0])
            # In an evaluation the original cuts the whole state: experiments/robot/openvla_utils.py#L669.
            fields[STATE_KEY] = Normalization(
                kind="q01_q99", mask=mask_all_but(n_state), clip=True, clip_unmasked=True
            )
        return fields

    @property
    def encoder_settings(self) -> dict[str, Any]:
        """What our normalising steps are made from, statistics aside; a base's own are replaced by it."""
        return {"fields": self.normalizations(), "gripper": self.gripper_spec()}

    def lora_defaults(self) -> dict[str, Any]:
        """Return what LoRA trains unless a recipe says otherwise, in peft's words."""
        full = [name for name in FULL_MODULES if self._has(name)]
        return {
            "target_modules": LORA_TARGETS,
            "modules_to_save": full or None,
            "init_lora_weights": "gaussian",
        }

    def _has(self, module: str) -> bool:
        return self.head == "l1" if module == "action_head" else self.use_proprio

    @property
    def observation_delta_indices(self) -> None:
        """The frame itself."""
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        """One chunk."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None

    def get_optimizer_preset(self) -> Any:
        """Return lerobot's configuration of AdamW."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> Any:
        """Return the configuration of the schedule."""
        return StepDecaySchedulerConfig(
            num_decay_steps=self.scheduler_decay_steps, num_warmup_steps=self.scheduler_warmup_steps
        )
