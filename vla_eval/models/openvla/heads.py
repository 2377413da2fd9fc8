"""The continuous head of OpenVLA-OFT and its projector of proprioception.

Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
prismatic/models/action_heads.py#L10-L108 and prismatic/models/projectors.py#L6-L22. Modules have the
names of the original, so that its checkpoints fit.
"""

from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.shared.precision import in_float32

N_BLOCKS = 2


class ResidualBlock(nn.Module):
    """LayerNorm, linear, ReLU, and what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ffn = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU())

    def forward(self, values: Tensor) -> Tensor:
        """(…, width) to the same."""
        changed: Tensor = values + self.ffn(values)
        return changed


class ResidualMlp(nn.Module):
    """(…, n_in) to (…, n_out) through residual blocks of `width`."""

    def __init__(self, *, n_in: int, width: int, n_out: int) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(n_in)
        self.fc1 = nn.Linear(n_in, width)
        self.mlp_resnet_blocks = nn.ModuleList(ResidualBlock(width) for _ in range(N_BLOCKS))
        self.layer_norm2 = nn.LayerNorm(width)
        self.fc2 = nn.Linear(width, n_out)

    def forward(self, values: Tensor) -> Tensor:
        """Return (…, n_out)."""
        values = functional.relu(self.fc1(self.layer_norm1(values)))
        for block in self.mlp_resnet_blocks:
            values = block(values)
        predicted: Tensor = self.fc2(self.layer_norm2(values))
        return predicted


class L1Head(nn.Module):
    """Hidden states of a chunk's placeholders to its actions, each from its own tokens."""

    def __init__(self, *, llm_width: int, chunk: int, action: int) -> None:
        super().__init__()
        self.chunk = chunk
        self.model = ResidualMlp(n_in=action * llm_width, width=llm_width, n_out=action)

    @in_float32
    def forward(self, hidden: Tensor) -> Tensor:
        """(B, chunk · action, llm) to normalised actions (B, chunk, action), float32."""
        hidden = hidden.to(self.model.fc1.weight.dtype)
        actions: Tensor = self.model(hidden.reshape(len(hidden), self.chunk, -1))
        return actions.float()


class ProprioProjector(nn.Module):
    """Normalised proprioception (B, proprio) to one token (B, 1, llm)."""

    def __init__(self, *, proprio: int, llm_width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(proprio, llm_width)
        self.fc2 = nn.Linear(llm_width, llm_width)

    @in_float32
    def forward(self, proprio: Tensor) -> Tensor:
        """Return the token."""
        token: Tensor = self.fc2(functional.gelu(self.fc1(proprio.to(self.fc1.weight.dtype))))
        return token[:, None]
