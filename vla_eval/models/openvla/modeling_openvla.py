"""OpenVLA and OpenVLA-OFT as a LeRobot policy: loss of a chunk, chunks of several episodes at once."""

from typing import Any  # lerobot and transformers are untyped

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY, STATE_KEY
from vla_eval.models.openvla.configuration_openvla import (
    AUGMENTATION,
    FULL_MODULES,
    TYPE,
    MikasaOpenVLAConfig,
)
from vla_eval.models.openvla.generation import generated_actions, parallel_actions, token_loss
from vla_eval.models.openvla.network import Inputs, OpenVLANetwork, finished
from vla_eval.models.shared.chunks import PromptedChunks
from vla_eval.models.shared.images import (
    MAX_LEVEL,
    Size,
    augment,
    centre_crop,
    resize_lanczos3,
    truncated_levels,
)
from vla_eval.models.shared.precision import default_dtype


class MikasaOpenVLAPolicy(PromptedChunks, PreTrainedPolicy):  # type: ignore[misc]  # lerobot is untyped
    """See `MikasaOpenVLAConfig`."""

    config_class = MikasaOpenVLAConfig
    name = TYPE
    draws_nothing = True
    new_in_finetuning = tuple(f"network.{name}." for name in FULL_MODULES)
    """Weights that a base checkpoint need not have: a plain OpenVLA has no continuous head."""

    def __init__(self, config: MikasaOpenVLAConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: MikasaOpenVLAConfig = config
        with default_dtype(getattr(torch, config.dtype)):
            self.network = OpenVLANetwork(config.network_sizes(), config.network_options())
        for name in FULL_MODULES:
            if hasattr(self.network, name):
                getattr(self.network, name).float()
        if config.gradient_checkpointing:
            for part in (self.network.vision.dino, self.network.vision.siglip, self.network.llm):
                part.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
        self.reset()

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of training samples, and its parts."""
        actions = batch[ACTION_KEY].float()
        counts = self._counts(batch.get(ACTION_PADDING_KEY), actions)
        inputs = self._inputs(batch, changed=self.training)
        if self.config.head != "l1":
            loss = token_loss(self.network, inputs, actions, counts)
            return loss, {"cross_entropy": loss.item()}
        errors = (self.network.actions(inputs) - actions).abs().mean(dim=-1)
        loss = (errors * counts).sum() / counts.sum().clamp(min=1)
        return loss, {"l1": loss.item(), "l1_first_action": errors[:, 0].mean().item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return normalised actions (B, chunk, action), the first of them for the frame that was given."""
        self.eval()
        inputs = self._inputs(batch, changed=False)
        if self.config.head == "l1":
            return self.network.actions(inputs)
        predict = generated_actions if self.config.head == "tokens" else parallel_actions
        return predict(self.network, inputs)

    def _inputs(self, batch: dict[str, Tensor], *, changed: bool) -> Inputs:
        proprio = batch[STATE_KEY] if self.config.use_proprio else None
        prompts = finished(*self._prompt(batch), self.network.sizes)
        return Inputs(self._images(batch, changed=changed), prompts, proprio)

    def _images(self, batch: dict[str, Tensor], *, changed: bool) -> Tensor:
        """Return (B, cameras, 3, edge, edge) in [0, 1], resized and either changed at random or cropped.

        Source of the whole levels: in training https://github.com/moojink/dlimp_openvla/blob/
        040105d256bd28866cc6620621a3d5f7b6b91b46/dlimp/augmentations.py#L125, in evaluation https://github.com/
        moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/experiments/robot/openvla_utils.py#L623.
        """
        edge = self.network.sizes.image_px
        images = []
        for name in self.config.image_fields:
            levels = resize_lanczos3(self._levels(batch, name), Size(edge, edge))
            if self.config.image_augmentation and changed:
                levels = truncated_levels(augment(levels[:, None], AUGMENTATION)[:, 0])
            elif self.config.image_augmentation:
                levels = centre_crop(levels, AUGMENTATION.centre_area, whole=truncated_levels)
            images.append(levels / MAX_LEVEL)
        return torch.stack(images, dim=1)
