"""What the configurations of our own policies share: chunks, optimizer, schedule, normalisation."""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, ClassVar  # lerobot is untyped

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from vla_eval.errors import RecipeError, check_names, unknown_name
from vla_eval.features import ACTION_KEY
from vla_eval.models.shared.gripper import Gripper
from vla_eval.models.shared.network_sizes import with_changes
from vla_eval.models.shared.normalization import Normalization, mask_all_but
from vla_eval.models.shared.precision import DTYPES
from vla_eval.strict.bounds import require


@dataclass
class PortedConfig(PreTrainedConfig):  # type: ignore[misc]  # lerobot is untyped
    """A policy that predicts chunks and is trained with AdamW."""

    reward_delta_indices: ClassVar[Any] = None  # no rewards, unless a policy says otherwise

    chunk_size: int = 8  # actions of a chunk
    # how many lerobot's own loop executes, the first ones; ours sets its own number
    n_action_steps: int = 8

    optimizer_lr: float = 5e-4
    optimizer_weight_decay: float = 0.01
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 0  # over which the learning rate rises from 0

    # of lerobot's own normaliser, which none of these policies uses
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        n, most = self.n_action_steps, self.chunk_size
        require(1 <= n <= most, "n_action_steps", n, f"1 to chunk_size ({most})")

    def check_choice(self, name: str, known: Collection[str]) -> None:
        """Raise `UnknownNameError` unless the field's value is one of these."""
        if getattr(self, name) not in known:
            raise unknown_name(name, getattr(self, name), known, where=f"policy ({self.type})")

    def check_one_size(self) -> None:
        """Raise unless all images have one size."""
        shapes = {tuple(feature.shape) for feature in self.image_features.values()}
        if len(shapes) != 1:
            raise ValueError(f"'{self.type}' needs images of one size, found {sorted(shapes)}")

    def get_optimizer_preset(self) -> Any:
        """Return lerobot's configuration of AdamW."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> Any:
        """Return lerobot's configuration of the schedule: a cosine after the warm-up, to 0 unless said."""
        return CosineDecayWithWarmupSchedulerConfig(
            peak_lr=self.optimizer_lr,
            decay_lr=getattr(self, "scheduler_decay_lr", 0.0),
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=getattr(self, "scheduler_decay_steps", 0),
        )


@dataclass
class PromptedConfig(PortedConfig):
    """A policy whose language model reads images and a prompt: one frame in, one chunk out."""

    observation_delta_indices: ClassVar[None] = None  # the frame itself
    sizes_class: ClassVar[Any]  # the policy's `NetworkSizes`

    # fields of the images that are read, in this order
    pictures: list[str] = field(default_factory=list)
    # sizes that differ from the published model's, see the policy's `NetworkSizes`
    sizes: dict[str, int] = field(default_factory=dict)
    dtype: str = "bfloat16"  # of the network: `float32`, `bfloat16`
    gradient_checkpointing: bool = False  # recompute activations in the backward pass
    gripper: str = "maniskill"
    # leave actions beyond an episode's end out of the loss. False: chunks that have any are refused.
    do_mask_loss_for_padding: bool = False
    drop_n_last_frames: int = 0  # set by `__post_init__` for that; lerobot's sampler reads it
    tokenizer_name: str = ""  # folder or name of the tokenizer; `bytes`: see `byte_tokenizer`
    prompt_max_tokens: int = 256  # a longer prompt is an error

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("dtype", DTYPES)
        self.gripper_spec()
        self.network_sizes()
        self.drop_n_last_frames = 0 if self.do_mask_loss_for_padding else self.chunk_size - 1

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        if not self.image_features or self.action_feature is None:
            raise RecipeError(f"'{self.type}' needs images and an action.")
        check_names("image", self.pictures, self.image_features, where=f"`policy.pictures` ({self.type})")

    def network_sizes(self) -> Any:
        """Return the sizes of the network."""
        return with_changes(self.sizes_class, self.sizes)

    def gripper_spec(self) -> Gripper:
        """Return how the gripper is encoded."""
        encoding: Any = self.gripper  # `Gripper` checks it
        return Gripper(encoding=encoding)

    def normalizations(self) -> dict[str, Normalization]:
        """Return how fields are normalised: q01 … q99 to [-1, 1], cut there; the gripper stays as it is.

        Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
        prismatic/vla/datasets/rlds/utils/data_utils.py#L52-L90, and of SpatialVLA data/utils/data_utils.py;
        data.norm.* of the golden files of both.
        """
        mask = mask_all_but(int(self.action_feature.shape[0]), left_alone=(-1,))
        return {ACTION_KEY: Normalization(kind="q01_q99", mask=mask, clip=True)}

    @property
    def encoder_settings(self) -> dict[str, Any]:
        """What our normalising steps are made from, statistics aside; a base's own are replaced by it."""
        return {"fields": self.normalizations(), "gripper": self.gripper_spec()}

    @property
    def action_delta_indices(self) -> list[int]:
        """One chunk."""
        return list(range(self.chunk_size))
