"""How the sequence policies make a chunk of what was decided: at once, or by flow matching from noise."""

from collections.abc import Callable

import torch
from lerobot.policies.common.flow_matching import euler_integrate, sample_time_beta
from torch import Tensor, nn

from vla_eval.models.cores.gated import Gated
from vla_eval.models.sequence.sizes import FLOW_TIME, N_FLOW_LAYERS
from vla_eval.models.shared.prefix import Prefix


class PrefixReader(nn.Module):
    """What lets a head that makes a chunk at once read a prefix: nothing, without `prefix_steps`."""

    def __init__(self, width: int, shape: tuple[int, int], *, prefix_steps: int) -> None:
        super().__init__()
        self.shape, self.prefix_steps = shape, prefix_steps
        self.read = nn.Linear(prefix_steps * (shape[1] + 1), width) if prefix_steps else None

    def forward(self, decided: Tensor, prefix: Prefix | None) -> Tensor:
        """Return what is decided, (…, width), with the prefix in it."""
        if self.read is None:
            return decided
        if prefix is None:
            first = decided.new_zeros(*decided.shape[:-1], self.prefix_steps, self.shape[1] + 1)
        else:
            marked = torch.cat([prefix.actions, torch.ones_like(prefix.actions[..., :1])], dim=-1)
            first = (marked * prefix.mask[..., None])[..., : self.prefix_steps, :]
        told: Tensor = self.read(first.flatten(-2))
        return decided + told


class FlowHead(nn.Module):
    """Flow matching over a chunk, as π0's: noise at time 1, actions at time 0, on straight lines.

    Each row has a time of its own, so that rows of a prefix are given as they are, at time 0.
    """

    def __init__(self, width: int, shape: tuple[int, int]) -> None:
        super().__init__()
        chunk, dims = shape
        self.shape = shape
        self.noisy = nn.Linear(chunk * (dims + 3), width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(2 * width), Gated(2 * width, width)) for _ in range(N_FLOW_LAYERS)
        )
        self.velocity = nn.Linear(width, chunk * dims)

    def forward(self, noisy: Tensor, times: Tensor, decided: Tensor) -> Tensor:
        """Return velocities (…, chunk, action) of noisy chunks, with the times of rows (…, chunk)."""
        angles = times[..., None] * torch.pi
        rows = torch.cat([noisy, times[..., None], angles.sin(), angles.cos()], dim=-1)
        hidden = self.noisy(rows.flatten(-2))
        for layer in self.layers:
            hidden = hidden + layer(torch.cat([hidden, decided], dim=-1))
        velocity: Tensor = self.velocity(hidden).unflatten(-1, self.shape)
        return velocity

    def errors(self, decided: Tensor, actions: Tensor, prefix: Prefix | None) -> Tensor:
        """Return squared errors (…, chunk) of velocities, at times and from noise drawn by torch."""
        n_chunks = actions.shape[:-2].numel()
        times = sample_time_beta(n_chunks, actions.device, **FLOW_TIME)
        times = times.reshape(*actions.shape[:-2], 1).expand(actions.shape[:-1])
        if prefix is not None:
            times = times.masked_fill(prefix.mask, 0.0)
        noise = torch.randn_like(actions)
        noisy = times[..., None] * noise + (1 - times[..., None]) * actions
        found: Tensor = (self(noisy, times, decided) - (noise - actions)).square().mean(dim=-1)
        return found

    def sample(
        self,
        decided: Tensor,
        noise: Tensor,
        n_steps: int,
        *,
        prefix: Prefix | None = None,
        integrate: Callable[..., Tensor] = euler_integrate,
    ) -> Tensor:
        """Return chunks (B, chunk, action) from noise of that shape; `integrate` may guide them."""

        def velocity(noisy: Tensor, time: Tensor) -> Tensor:
            times = time[:, None].expand(noisy.shape[:-1])
            if prefix is not None:
                noisy, times = prefix.put_into(noisy), times.masked_fill(prefix.mask, 0.0)
            found: Tensor = self(noisy, times, decided)
            return found

        actions = integrate(velocity, noise, n_steps)
        return actions if prefix is None else prefix.put_into(actions)
