"""Plain policies as a LeRobot policy: imitation over whole episodes, memory from frame to frame."""

from typing import Any, NamedTuple  # lerobot is untyped

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.features import STATE_KEY
from vla_eval.policies.eef_state import POSITION_SCALE, SPACE
from vla_eval.policies.episode_policy import EpisodePolicy
from vla_eval.policies.episode_samples import episodes_of, goal_missed, stacked_images, weighted_mean
from vla_eval.policies.sequence.configuration_sequence import TYPE, MikasaSequenceConfig
from vla_eval.policies.sequence.cores import CoreMemory, make_core
from vla_eval.policies.sequence.encoders import Keypoints, Nature
from vla_eval.policies.sequence.sizes import CORES
from vla_eval.policies.steps.precision import in_float32

ENCODERS = {"keypoints": Keypoints, "nature": Nature}


class Predicted(NamedTuple):
    """What the network predicts at each step.

    Attributes:
        actions: (B, T, chunk, action).
        goal_m: (B, T, 3) where the demonstration's tool centre point ends.
    """

    actions: Tensor
    goal_m: Tensor


class Gated(nn.Module):
    """A layer whose outputs are products: a linear map, gated by another one (Shazeer 2020, SwiGLU)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.values, self.gates = nn.Linear(inputs, outputs), nn.Linear(inputs, outputs)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (…, outputs) of (…, inputs)."""
        gated: Tensor = functional.silu(self.gates(inputs)) * self.values(inputs)
        return gated


class SequenceNetwork(nn.Module):
    """An encoder for each camera, a token for each step, a core over the steps, a head.

    Args:
        config: sizes and names of the parts.
    """

    def __init__(self, config: MikasaSequenceConfig) -> None:
        super().__init__()
        width, images = config.width, config.image_features
        image_px = int(next(iter(images.values())).shape[-1])
        make = ENCODERS[config.encoder]
        self.encoders = nn.ModuleList(make(image_px=image_px, outputs=width) for _ in images)
        n_state = int(config.robot_state_feature.shape[0])
        self.token = nn.Sequential(
            nn.Linear(len(images) * width + n_state, width), nn.LayerNorm(width), nn.GELU()
        )
        self.core = make_core(
            config.core,
            width=width,
            layers=config.layers,
            heads=config.heads,
            context_steps=config.context_steps,
            dropout=config.dropout,
        )
        self.head = nn.Sequential(Gated(2 * width, width), nn.LayerNorm(width), Gated(width, width))
        self.shape = (config.chunk_size, int(config.action_feature.shape[0]))
        self.actions = nn.Linear(width, self.shape[0] * self.shape[1])
        self.goal = nn.Linear(width, SPACE)

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return the memory before the first step; its last tensor is the core's answer, (B, width)."""
        nothing = self.actions.weight.new_zeros(n_episodes, self.actions.in_features)
        return (*self.core.begin(n_episodes), nothing)

    def tokens(self, images: Tensor, state: Tensor) -> Tensor:
        """Return (B, T, width) of images (B, T, cameras, 3, H, W) in [0, 1] and state (B, T, state)."""
        shape = state.shape[:2]
        seen = [
            encoder((2 * images[:, :, index] - 1).flatten(0, 1)).unflatten(0, shape)
            for index, encoder in enumerate(self.encoders)
        ]
        token: Tensor = self.token(torch.cat([*seen, state * POSITION_SCALE], dim=-1))
        return token

    def read(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """Return the core's answers (B, T, width), and the memory after the last step."""
        answers, kept = self.core(tokens, memory[:-1])
        return answers, (*kept, answers[:, -1])

    @in_float32
    def predict(self, tokens: Tensor, answers: Tensor) -> Predicted:
        """Return what is predicted at each step, both inputs (B, T, width)."""
        decided = self.head(torch.cat([tokens, answers], dim=-1))
        return Predicted(
            actions=self.actions(decided).unflatten(-1, self.shape),
            goal_m=self.goal(decided) / POSITION_SCALE,
        )


class MikasaSequencePolicy(EpisodePolicy):
    """See `MikasaSequenceConfig`; it has a memory if its core has one."""

    config_class = MikasaSequenceConfig
    name = TYPE

    def __init__(self, config: MikasaSequenceConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: MikasaSequenceConfig = config
        self.network = SequenceNetwork(config)
        self.set_memory(self.network.begin, remembers=CORES[config.core].remembers)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of training samples, and its parts."""
        config, network = self.config, self.network
        episodes = episodes_of(batch, config, training=self.training)
        real = episodes.counts[..., 0] > 0
        # Images are most of the work: those of padding are not encoded.
        encoded = network.tokens(episodes.images[real][None], episodes.state[real][None])[0]
        tokens = encoded.new_zeros(*real.shape, encoded.shape[-1]).masked_scatter(real[..., None], encoded)
        answers, _ = network.read(tokens, network.begin(len(tokens)))
        predicted = network.predict(tokens, answers)
        errors = (predicted.actions - episodes.actions).square().mean(dim=-1)
        imitation = weighted_mean(errors, episodes.counts)
        # Weighted as the actions are: once the arm moves, its motion gives the goal away, and the one frame
        # at which the choice has to be made from memory would count for little.
        goal = goal_missed(predicted.goal_m, episodes.goal_m, episodes.counts.sum(dim=-1))
        parts = {"imitation": imitation, "goal": goal}
        loss = imitation + config.goal_weight * goal
        return loss, {name: float(part.detach()) for name, part in parts.items()}

    @torch.no_grad()
    def _remember(self, batch: dict[str, Tensor], memory: CoreMemory | None) -> CoreMemory:
        """Return the memory after the frames (B, T, …) of a batch; None: an episode begins."""
        self.eval()
        state = batch[STATE_KEY]
        before = self.network.begin(len(state)) if memory is None else memory
        _, after = self.network.read(self.network.tokens(stacked_images(batch, self.config), state), before)
        return after

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], memory: CoreMemory | None = None, **kwargs: Any
    ) -> Tensor:
        """Return (B, chunk, action) for one frame per episode, (B, …); `memory` has that frame in it already.

        A policy without a memory takes none.
        """
        self.eval()
        self.check_shown(memory)
        images, state = stacked_images(batch, self.config)[:, None], batch[STATE_KEY][:, None]
        tokens = self.network.tokens(images, state)
        if memory is None:
            _, memory = self.network.read(tokens, self.network.begin(len(tokens)))
        return self.network.predict(tokens, memory[-1][:, None]).actions[:, 0].clamp(-1, 1)
