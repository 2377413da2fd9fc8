"""lerobot's configuration of SpatialVLA; `docs/spatialvla.md` explains it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any  # lerobot is untyped

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from vla_eval.errors import RecipeError
from vla_eval.features import ACTION_KEY, CAMERA_KEYS
from vla_eval.models.shared.normalization import Normalizer
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
from vla_eval.models.spatialvla.action_grid import ActionGrid, fitted_gaussians, gaussian_grid, uniform_grid
from vla_eval.models.spatialvla.sizes import ATTENTIONS, N_ACTION, TOKENS_PER_ACTION, Attention, NetworkSizes
from vla_eval.strict.bounds import require

TYPE = "mikasa_spatialvla"
GRIDS = ("refitted", "kept", "uniform")
# What LoRA trains of SpatialVLA, by name. The original names ends of modules (`q_proj`, `out_proj`,
# `linear` …) in the whole model, which also hits the `out_proj` of four blocks of the frozen depth model;
# here whole names are given, and none of those. Source: scripts/spatialvla_4b_finetune/finetune_lora.sh and
# train/spatialvla_finetune.py of the original at
# https://github.com/SpatialVLA/SpatialVLA/tree/e48075326a92116adaaf1232cf01471f15f09a73.
_SIGLIP = r"vision\.encoder\.layers\.\d+\.(self_attn\.(q_proj|k_proj|v_proj|out_proj)|mlp\.fc[12])"
_GEMMA = r"llm\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
_PLACES = r"position_embedding_3d\.position_embedding_head\.[03]"
LORA_TARGETS = rf"network\.({_SIGLIP}|{_GEMMA}|{_PLACES}|projector)"
"""Regular expression of the modules that get an adapter; it has to match a whole name."""
SPATIAL_EMBEDDINGS = "spatial_embed_tokens"
"""Module that is trained in full in addition to the adapters, if asked for; the original leaves it."""


@LRSchedulerConfig.register_subclass("mikasa_linear_decay")
@dataclass
class LinearDecaySchedulerConfig(LRSchedulerConfig):  # type: ignore[misc]  # lerobot is untyped
    """Rises from nothing for some steps, then falls in a straight line to nothing at the last step."""

    num_warmup_steps: int | None = 0

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Return torch's scheduler."""
        n_warmup = self.num_warmup_steps or 0

        def factor(step: int) -> float:
            if step < n_warmup:
                return step / n_warmup
            return max(0.0, (num_training_steps - step) / max(1, num_training_steps - n_warmup))

        return LambdaLR(optimizer, factor)


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaSpatialVLAConfig(PromptedConfig):
    """SpatialVLA, which is trained by AdamW with `mikasa_linear_decay`."""

    chunk_size: int = 4  # actions of a chunk, three tokens each
    n_action_steps: int = 4
    # the base camera alone, as the original does; with the wrist's it is an extension of ours
    pictures: list[str] = field(default_factory=lambda: [CAMERA_KEYS["base_camera"]])
    # vertical field of view of their cameras, from which their matrices are made. MIKASA's cameras have
    # a quarter turn; an evaluation with others is refused.
    camera_fov_rad: float = math.pi / 2
    # where a fine-tuning has the bins: `refitted` to the dataset's actions (tokens of a base are moved
    # along), `kept` as the base has them, `uniform`
    action_grid: str = "refitted"
    # edges of the bins, axis by axis (`action_grid.AXES`); set by a fine-tuning or a conversion
    grid: list[list[float]] = field(default_factory=list)
    # those of the base, if they were others; set by a fine-tuning
    base_grid: list[list[float]] = field(default_factory=list)
    prefix_attention: str = "causal"  # what images and prompt attend to, see `sizes.Attention`
    # the same for inference; None becomes that of training. A converted checkpoint has `bidirectional`,
    # because the original predicts so, though its scripts train with `causal`. What is fine-tuned here
    # predicts as it was trained, whatever its base does.
    inference_attention: str | None = None
    train_spatial_embeddings: bool = False  # train the embeddings of the action tokens
    # train Gemma's own embeddings, and the matrix that predicts tokens
    train_word_embeddings: bool = False
    gripper: str = "unit_open"
    do_mask_loss_for_padding: bool = True
    tokenizer_name: str = "IPEC-COMMUNITY/spatialvla-4b-224-pt"

    optimizer_weight_decay: float = 0.0
    scheduler_warmup_steps: int = 250

    def __post_init__(self) -> None:
        super().__post_init__()
        self.inference_attention = self.inference_attention or self.prefix_attention
        self.check_choice("action_grid", GRIDS)
        self.check_choice("prefix_attention", ATTENTIONS)
        self.check_choice("inference_attention", ATTENTIONS)
        fov_rad = self.camera_fov_rad
        require(0 < fov_rad < math.pi, "camera_fov_rad", fov_rad, "radians in (0, π)")
        require(bool(self.pictures), "pictures", [], "the fields that are read, in order")

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        super().validate_features()
        found = tuple(self.action_feature.shape)
        if found != (N_ACTION,):
            raise RecipeError(
                f"'{TYPE}' predicts translation, rotation and gripper: expected actions of {N_ACTION} "
                f"numbers, found shape {found}."
            )

    sizes_class = NetworkSizes
    not_of_base = ("inference_attention",)  # a fine-tuning does not take it over
    reads_state = False

    def attention(self, *, training: bool) -> Attention:
        """Return what images and prompt attend to."""
        name: Any = self.prefix_attention if training else self.inference_attention
        chosen: Attention = name  # checked in `__post_init__`
        return chosen

    def fit_to_actions(self, actions: Tensor, statistics: Mapping[str, Any]) -> None:
        """Set the grid for the actions (N, 7) of all frames of a dataset; it was a base's, if any."""
        base, self.base_grid = self.grid, []
        if self.action_grid == "kept":
            if not base:
                raise RecipeError(
                    f"'{TYPE}': action_grid is 'kept', but there is no base with a grid. Name a "
                    "base_checkpoint, or choose 'refitted' or 'uniform'."
                )
            return
        bins = self.network_sizes().n_bins
        if self.action_grid == "uniform":
            chosen = uniform_grid(bins)
        else:
            spec = self.normalizations()[ACTION_KEY]
            normalizer = Normalizer(spec, statistics, where="statistics of the dataset's actions")
            normalized = normalizer.normalize(self.gripper_spec().encode(actions.to(torch.float64)))
            chosen = gaussian_grid(fitted_gaussians(normalized), bins)
        self.grid, self.base_grid = [list(edges) for edges in chosen.edges], base

    def current_grid(self) -> ActionGrid:
        """Return where the bins lie; raise `RecipeError` if that is not set, or for other tokens."""
        if not self.grid:
            raise RecipeError(
                f"'{TYPE}': there is no action grid. A fine-tuning sets it (action_grid), and so does "
                "`mikasa-vla checkpoint convert-spatialvla`."
            )
        return self._checked(self.grid)

    def former_grid(self) -> ActionGrid | None:
        """Return where the base's bins lay; None: where they lie now."""
        return self._checked(self.base_grid) if self.base_grid else None

    def _checked(self, edges: list[list[float]]) -> ActionGrid:
        grid = ActionGrid(edges=tuple(map(tuple, edges)))
        if grid.n_bins != self.network_sizes().n_bins:
            raise RecipeError(
                f"'{TYPE}': the action grid has {grid.n_bins} bins, expected {self.network_sizes().n_bins} "
                "(sizes)."
            )
        return grid

    def lora_defaults(self) -> dict[str, Any]:
        """Return what LoRA trains unless a recipe says otherwise, in peft's words."""
        full = [SPATIAL_EMBEDDINGS] if self.train_spatial_embeddings else None
        return {"target_modules": LORA_TARGETS, "modules_to_save": full}

    def get_scheduler_preset(self) -> Any:
        """Return the configuration of the schedule."""
        return LinearDecaySchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)


ZOE_PATCHES = 577  # of 384 px in patches of 16, and the class token


def network_stages(config: Any) -> Stages:
    """Return the parts of the network, and the tokens of a sample that pass through each."""
    images, actions = n_images(config), TOKENS_PER_ACTION * config.chunk_size
    return (
        Stage(r"lm_head", actions, HEAD),
        Stage(r"depth\.", images * ZOE_PATCHES, VISION - 1),
        Stage(r"vision|projector|position", images * PATCHES, VISION),
        Stage(r"\.llm\.", images * PATCHES + PROMPT_TOKENS + actions, LANGUAGE),
    )
