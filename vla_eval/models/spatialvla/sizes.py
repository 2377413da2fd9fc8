"""Sizes and token numbers of SpatialVLA; the defaults are the published model's. Knows nothing of torch.

Source: Qu et al. 2025 (arXiv 2501.15830) for the parts and their backbones; the sizes are those of
PaliGemma 2 3B (SigLIP so400m/14, Gemma 2 2B) and of `Intel/zoedepth-nyu-kitti`, which together have the
4,027,854,731 parameters of the published files. Gemma's output matrix is one of its own there.
"""

from dataclasses import dataclass
from typing import Literal

from vla_eval.errors import RecipeError
from vla_eval.models.shared.network_sizes import VisionSizes

Attention = Literal["causal", "bidirectional", "bidirectional_with_padding"]
"""What a token of the prefix (images and prompt) attends to; action tokens see all before them.

- `causal`: to nothing after it. What the original's training scripts do, which run flash attention.
- `bidirectional`: to the whole prefix. What the original does at inference with eager attention.
- `bidirectional_with_padding`: the same, and everybody sees the padding behind a row's last token, too: what
  the original does in training with eager attention. A sample's loss then depends on what is beside it in
  the batch; for comparisons only, and never at inference.
"""
ATTENTIONS: tuple[Attention, ...] = ("causal", "bidirectional", "bidirectional_with_padding")
SLIDING_WINDOW = 4096  # tokens that every other block of Gemma 2 sees; a longer sequence is an error
N_ACTION = 7  # translation, rotation, gripper
TOKENS_PER_ACTION = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSizes(VisionSizes):
    """Sizes of all parts."""

    llm_width: int = 2304
    llm_depth: int = 26
    llm_heads: int = 8
    llm_kv_heads: int = 4
    llm_head_width: int = 256
    llm_mlp: int = 9216
    # 1: Gemma has an output matrix of its own, as published; 0: that of its input, as Gemma 2 itself and
    # the golden files
    llm_own_head: int = 1
    # `depth_px`, `depth_width`, `depth_layers`, `depth_heads`, `depth_mlp`: ZoeDepth's encoder (BEiT);
    # without layers there is no depth model, and depth has to be given
    depth_px: int = 384
    depth_width: int = 1024
    depth_layers: int = 24
    depth_heads: int = 16
    depth_mlp: int = 4096
    depth_neck: int = 1024
    depth_fusion: int = 256
    depth_features: int = 32
    depth_embedding: int = 128
    depth_bins: int = 64
    # `theta_bins`, `phi_bins`, `r_bins`: of the translation's direction and length
    theta_bins: int = 16
    phi_bins: int = 32
    r_bins: int = 8
    roll_bins: int = 16
    pitch_bins: int = 16
    yaw_bins: int = 16
    pad_token: int = 0
    stop_token: int = 1
    bos_token: int = 2
    newline_token: int = 108
    image_token: int = 257152
    first_action_token: int = 257153  # of the first action token; they are the last of the vocabulary

    def __post_init__(self) -> None:
        VisionSizes.__post_init__(self)  # no super(): `slots` makes a new class of this one
        if self.depth_layers % 4:
            raise RecipeError(f"sizes.depth_layers is {self.depth_layers}, expected a multiple of 4.")
        if min(self.n_bins) < 2:
            raise RecipeError(
                f"sizes of the action grid are {self.n_bins}, expected 2 or more bins per axis."
            )
        words = (self.pad_token, self.stop_token, self.bos_token, self.newline_token, self.image_token)
        if self.first_action_token <= max(words):
            raise RecipeError(
                f"sizes.first_action_token is {self.first_action_token}, expected a number beyond all other "
                f"tokens ({max(words)})."
            )

    @property
    def n_bins(self) -> tuple[int, ...]:
        """Bins of each axis, in the order of `action_grid.AXES`."""
        return (self.theta_bins, self.phi_bins, self.r_bins, self.roll_bins, self.pitch_bins, self.yaw_bins)

    @property
    def n_translations(self) -> int:
        """Tokens for a translation."""
        return self.theta_bins * self.phi_bins * self.r_bins

    @property
    def n_rotations(self) -> int:
        """Tokens for a rotation."""
        return self.roll_bins * self.pitch_bins * self.yaw_bins

    @property
    def n_action_tokens(self) -> int:
        """Tokens for actions; the last two are the closed and the open gripper."""
        return self.n_translations + self.n_rotations + 2

    @property
    def vocabulary(self) -> int:
        """All tokens."""
        return self.first_action_token + self.n_action_tokens
