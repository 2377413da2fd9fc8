"""A layer of products, which heads over cores are made of."""

from torch import Tensor, nn
from torch.nn import functional


class Gated(nn.Module):
    """A layer whose outputs are products: a linear map, gated by another one (Shazeer 2020, SwiGLU)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.values, self.gates = nn.Linear(inputs, outputs), nn.Linear(inputs, outputs)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (…, outputs) of (…, inputs)."""
        gated: Tensor = functional.silu(self.gates(inputs)) * self.values(inputs)
        return gated
