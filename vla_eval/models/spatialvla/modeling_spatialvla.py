"""SpatialVLA as a LeRobot policy: loss of a chunk, chunks of several episodes at once."""

from typing import Any  # lerobot and transformers are untyped

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY
from vla_eval.models.shared.chunks import PromptedChunks
from vla_eval.models.shared.images import MAX_LEVEL, Size, resize_bicubic
from vla_eval.models.shared.precision import default_dtype
from vla_eval.models.spatialvla.action_grid import refitted
from vla_eval.models.spatialvla.configuration_spatialvla import TYPE, MikasaSpatialVLAConfig
from vla_eval.models.spatialvla.ego3d import intrinsics, resized_intrinsics
from vla_eval.models.spatialvla.generation import generated_actions, token_loss
from vla_eval.models.spatialvla.network import Inputs, SpatialVLANetwork, finished


class MikasaSpatialVLAPolicy(PromptedChunks, PreTrainedPolicy):  # type: ignore[misc]  # lerobot is untyped
    """See `MikasaSpatialVLAConfig`."""

    config_class = MikasaSpatialVLAConfig
    name = TYPE
    draws_nothing = True

    def __init__(self, config: MikasaSpatialVLAConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: MikasaSpatialVLAConfig = config
        self.grid = config.current_grid()
        with default_dtype(getattr(torch, config.dtype)):
            self.network = SpatialVLANetwork(config.network_sizes())
        self.network.spatial_embed_tokens.requires_grad_(config.train_spatial_embeddings)
        self.network.llm.embed_tokens.requires_grad_(config.train_word_embeddings)
        if self.network.sizes.llm_own_head:
            self.network.lm_head.requires_grad_(config.train_word_embeddings)
        if config.gradient_checkpointing:
            for part in (self.network.vision, self.network.llm):
                part.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
        self.reset()

    @torch.no_grad()
    def begin_from_base(self) -> None:
        """Move the rows that embed and predict the base's tokens to this grid; to be called once."""
        former = self.config.former_grid()
        if former is None:
            return
        network = self.network
        head = network.lm_head if network.sizes.llm_own_head else network.llm.embed_tokens
        predicting = head.weight[network.sizes.first_action_token :]
        for table in (network.spatial_embed_tokens.weight, predicting):
            table.copy_(refitted(table, former, self.grid))

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of training samples, and its parts."""
        actions = batch[ACTION_KEY].float()
        attention = self.config.attention(training=True)
        counts = self._counts(batch.get(ACTION_PADDING_KEY), actions)
        loss = token_loss(self.network, self.grid, self._inputs(batch), actions, counts, attention)
        return loss, {"cross_entropy": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return normalised actions (B, chunk, action), the first of them for the frame that was given."""
        self.eval()
        attention, chunk = self.config.attention(training=False), self.config.chunk_size
        return generated_actions(
            self.network, self.grid, self._inputs(batch), chunk=chunk, attention=attention
        )

    def _inputs(self, batch: dict[str, Tensor]) -> Inputs:
        """Return images, resized as PIL does it, the matrices of their cameras, and prompts."""
        edge = self.network.sizes.image_px
        images, matrices = [], []
        for name in self.config.pictures:
            levels = self._levels(batch, name)
            height_px, width_px = levels.shape[-2:]
            camera = intrinsics(height_px=height_px, width_px=width_px, fov_rad=self.config.camera_fov_rad)
            matrices.append(resized_intrinsics(camera, height_px=height_px, width_px=width_px, to_px=edge))
            images.append(resize_bicubic(levels, Size(edge, edge)) / MAX_LEVEL)
        shown = torch.stack(images, dim=1)
        cameras = torch.stack(matrices).to(shown.device).expand(len(shown), -1, -1, -1)
        return Inputs(shown, cameras, finished(*self._prompt(batch), self.network.sizes))
