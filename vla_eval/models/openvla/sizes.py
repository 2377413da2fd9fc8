"""Sizes and token numbers of OpenVLA; the defaults are the published model's. Knows nothing of torch.

Source of the sizes: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
prismatic/extern/hf/configuration_prismatic.py, and the timm models named there; of the token numbers:
prismatic/vla/constants.py and prismatic/extern/hf/modeling_prismatic.py at the same commit.
"""

from dataclasses import dataclass
from typing import Literal

from vla_eval.errors import RecipeError
from vla_eval.models.shared.network_sizes import VisionSizes

Head = Literal["l1", "parallel_tokens", "tokens"]
N_BINS = 256
"""Edges of the bins that an action token stands for; there is one bin less."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSizes(VisionSizes):
    """Sizes of all parts; the last block of SigLIP is never run either, like that of DINOv2."""

    # `dino_width`, `dino_depth`, `dino_heads`, `dino_registers`: DINOv2 as published. The last of
    # `dino_depth` blocks is never run: its output is not used, so the network does not have it.
    dino_width: int = 1024
    dino_depth: int = 24
    dino_heads: int = 16
    dino_registers: int = 4
    llm_width: int = 4096
    llm_depth: int = 32
    llm_heads: int = 32
    llm_mlp: int = 11008
    # rows of the embedding; `text_vocabulary`: those of the tokenizer. Action bins are the last `N_BINS
    # - 1` of the latter, counted from behind.
    vocabulary: int = 32064
    text_vocabulary: int = 32000
    bos_token: int = 1
    stop_token: int = 2
    pad_token: int = 32000
    empty_token: int = 29871

    def __post_init__(self) -> None:
        VisionSizes.__post_init__(self)  # no super(): `slots` makes a new class of this one
        if min(self.dino_depth, self.siglip_depth) < 2:
            raise RecipeError("sizes.dino_depth and sizes.siglip_depth: expected ≥ 2; the last is not used.")
        n_needed = max(self.text_vocabulary, self.pad_token + 1, self.empty_token + 1)
        if self.vocabulary < n_needed or self.text_vocabulary <= N_BINS:
            raise RecipeError(
                f"sizes.vocabulary is {self.vocabulary} and sizes.text_vocabulary {self.text_vocabulary}; "
                f"expected at least {n_needed}, and more than {N_BINS}."
            )

    @property
    def vision_width(self) -> int:
        """Channels of the fused features of a patch."""
        return self.dino_width + self.siglip_width


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkOptions:
    """What one model has in addition to its sizes."""

    # `l1`: all actions of the chunk at once, continuous (OFT). `parallel_tokens`: at once, as tokens
    # (OFT without its head). `tokens`: one token after the other (OpenVLA as published).
    head: Head = "l1"
    chunk: int = 8  # actions of a chunk; a part of the architecture, it cannot be changed after training
    action: int = 7
    proprio: int = 0  # numbers of the proprioception; 0: the model has none

    @property
    def n_action_tokens(self) -> int:
        """Tokens of a chunk."""
        return self.chunk * self.action
