"""lerobot's configuration of Octo; `docs/octo.md` explains it. The defaults are Octo-small's."""

from dataclasses import dataclass, field
from typing import Any, Literal  # lerobot is untyped

from lerobot.configs import PreTrainedConfig

from vla_eval.errors import check_names
from vla_eval.features import ACTION_KEY
from vla_eval.models.octo.diffusion_head import HeadSizes
from vla_eval.models.octo.language import T5Sizes
from vla_eval.models.octo.transformer import PATCH_PX, TransformerSizes
from vla_eval.models.shared.gripper import Gripper, GripperDecoding, GripperEncoding
from vla_eval.models.shared.images import Augmentation
from vla_eval.models.shared.network_sizes import sizes_from
from vla_eval.models.shared.normalization import Normalization, mask_all_but
from vla_eval.models.shared.ported_config import PortedConfig
from vla_eval.models.shared.stages import HEAD, LANGUAGE, VISION, Stage, Stages

TYPE = "mikasa_octo"
BYTES_TOKENIZER = "bytes"
"""In `tokenizer_name`: each byte is a token, no file is needed; for models trained from scratch."""

Trained = Literal["heads", "heads_and_positions", "all"]
TRAINED: dict[Trained, tuple[str, ...]] = {
    "heads": (r"network\.head\..*",),
    "heads_and_positions": (r"network\.head\..*", r"network\.transformer\..*positions.*"),
    "all": (r"network\..*",),
}
"""Which parameters are trained, by name. The text encoder never is."""


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaOctoConfig(PortedConfig):
    """Octo, Octo Model Team 2024 (arXiv:2405.12213).

    For the sizes, see `TransformerSizes`, `HeadSizes`, `T5Sizes`; for the rest, `Augmentation` and `Gripper`.
    AdamW decays `flax_names.is_kernel` alone; after the warm-up its learning rate is a cosine to 0.
    """

    # camera of the model -> field of the dataset
    cameras: dict[str, str] = field(
        default_factory=lambda: {"primary": "observation.images.base", "wrist": "observation.images.wrist"}
    )
    # camera of the model -> edge that its images are resized to
    image_px: dict[str, int] = field(default_factory=lambda: {"primary": 256, "wrist": 128})
    window: int = 10  # frames that it sees, the newest included; what lies before the episode is masked
    max_window: int = 10  # longest window that there are position embeddings for
    chunk_size: int = 4
    n_action_steps: int = 4
    trained: Trained = "heads"  # which parameters, see `TRAINED`
    # compute the frozen trunk's output for each training frame once; needs `trained: heads` and no
    # augmentation. Another recipe than the paper's, see `docs/octo.md`.
    remember_readouts: bool = False

    width: int = 384
    layers: int = 12
    heads: int = 6
    mlp_width: int = 1536
    stem_channels: tuple[int, ...] = (32, 96, 192, 384)
    stem_features: int = 512
    head_hidden: int = 256
    head_blocks: int = 3
    head_time: int = 32
    diffusion_steps: int = 20
    max_action: float = 5.0

    language_tokens: int = 16  # of an instruction; longer ones are cut, as in the original
    t5: dict[str, int] = field(default_factory=dict)  # what is not named is t5-base's
    tokenizer_name: str = "google-t5/t5-base"  # folder or name, or `bytes`

    # Source: scripts/configs/finetune_config.py of the original, workspace and wrist augmentation.
    augment: bool = True
    # only the first camera is cropped, and in evaluation its middle is taken
    primary_crop_area: tuple[float, float] | None = (0.8, 1.0)
    primary_crop_ratio: tuple[float, float] = (0.9, 1.1)
    brightness: float = 0.1
    contrast: tuple[float, float] = (0.9, 1.1)
    saturation: tuple[float, float] = (0.9, 1.1)
    hue: float = 0.05

    gripper_encoding: GripperEncoding = "maniskill"
    gripper_decoding: GripperDecoding = "continuous"
    normalize_gripper: bool = False  # the original leaves it alone

    # Source: the same file.
    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 0.01
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 2000
    scheduler_decay_steps: int = 50_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.window <= self.max_window:
            raise ValueError(f"window is {self.window}, expected 1 to max_window ({self.max_window})")
        if not self.cameras or self.cameras.keys() != self.image_px.keys():
            raise ValueError(
                f"cameras and image_px have to name the same cameras, found {', '.join(self.cameras)} and "
                f"{', '.join(self.image_px)}"
            )
        for camera, px in self.image_px.items():
            if px < PATCH_PX or px % PATCH_PX:
                raise ValueError(f"image_px.{camera} is {px}, expected a multiple of {PATCH_PX}")
        if self.remember_readouts and (self.trained != "heads" or self.augment):
            raise ValueError(
                "remember_readouts needs trained: heads and augment: false: else the trunk's output for a "
                "frame is not the same each time"
            )

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        if self.action_feature is None:
            raise ValueError(f"'{TYPE}' needs the field action")
        check_names("image", self.cameras.values(), self.image_features, where=f"policy.cameras ({TYPE})")

    reads_state = False  # the published checkpoints have no proprioception
    masks_history = True  # our adapter marks which frames lie before the episode

    @property
    def noise_shape(self) -> tuple[int, int]:
        """What one inference draws: the start, and what each diffusion step adds."""
        return (self.diffusion_steps + 1, self.head_sizes.flat)

    @property
    def transformer_sizes(self) -> TransformerSizes:
        """What the transformer is made of."""
        return sizes_from(
            TransformerSizes,
            self,
            language_width=self.t5_sizes.width,
            stem_channels=tuple(self.stem_channels),
        )

    @property
    def head_sizes(self) -> HeadSizes:
        """What the head is made of."""
        return sizes_from(
            HeadSizes,
            self,
            condition=self.width,
            chunk=self.chunk_size,
            action=int(self.action_feature.shape[0]),
            hidden=self.head_hidden,
            blocks=self.head_blocks,
            time=self.head_time,
        )

    @property
    def t5_sizes(self) -> T5Sizes:
        """What the text encoder is made of."""
        return T5Sizes(**self.t5)

    @property
    def gripper(self) -> Gripper:
        """How the gripper is encoded; it is the action's last dimension."""
        return Gripper(encoding=self.gripper_encoding, decoding=self.gripper_decoding)

    @property
    def encoder_settings(self) -> dict[str, Any]:
        """What our normalising steps are made from, statistics aside; a base's own are replaced by it."""
        left_alone = () if self.normalize_gripper else (self.gripper.dim,)
        mask = mask_all_but(int(self.action_feature.shape[0]), left_alone=left_alone)
        return {"fields": {ACTION_KEY: Normalization(kind="mean_std", mask=mask)}, "gripper": self.gripper}

    def augmentation(self, camera: str) -> Augmentation:
        """Return how training images of a camera are changed; the first one is cropped, too."""
        is_first = camera == next(iter(self.cameras))
        return Augmentation(
            crop_area=self.primary_crop_area if is_first else None,
            crop_ratio=self.primary_crop_ratio,
            brightness=self.brightness,
            contrast=self.contrast,
            saturation=self.saturation,
            hue=self.hue,
        )

    @property
    def observation_delta_indices(self) -> list[int]:
        """The window up to the frame."""
        return list(range(1 - self.window, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """A chunk for each frame of the window."""
        return list(range(1 - self.window, self.chunk_size))


PROMPT_TOKENS, FRAME_TOKENS = 16, 337  # docs/octo.md


def network_stages(config: Any) -> Stages:
    """Return the parts of the network, and the tokens of a sample that pass through each."""
    return (
        Stage(r"language\.", PROMPT_TOKENS, VISION - 1),
        Stage(r"head\.", config.window, HEAD),
        Stage(r"transformer\.", PROMPT_TOKENS + FRAME_TOKENS * config.window, LANGUAGE),
    )
