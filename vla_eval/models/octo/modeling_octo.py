"""Octo as a LeRobot policy. Legend: B batch, W steps, L tokens of the instruction, D width."""

from collections import deque
from collections.abc import Mapping
from typing import Any  # lerobot is untyped

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from vla_eval.errors import SpecMismatchError
from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY
from vla_eval.models.octo.configuration_octo import TRAINED, TYPE, MikasaOctoConfig
from vla_eval.models.octo.diffusion_head import Targets, draw
from vla_eval.models.octo.flax_names import is_kernel
from vla_eval.models.octo.language import PromptEmbeddings, make_text_encoder
from vla_eval.models.octo.transformer import OctoNetwork, Window
from vla_eval.models.shared.images import MAX_LEVEL, Size, augment, resize_and_centre_crop, resize_lanczos3
from vla_eval.models.weights.trainable import set_trainable

INDEX_KEY = "index"  # of a frame in the dataset


class MikasaOctoPolicy(PreTrainedPolicy):  # type: ignore[misc]  # lerobot is untyped
    """See `MikasaOctoConfig`."""

    config_class = MikasaOctoConfig
    name = TYPE

    def __init__(self, config: MikasaOctoConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: MikasaOctoConfig = config
        self.network = OctoNetwork(config.transformer_sizes, config.head_sizes)
        self.language = make_text_encoder(config.t5_sizes)
        set_trainable(self, TRAINED[config.trained], what="policy.trained")
        self._prompts = PromptEmbeddings()
        self._readouts: dict[int, Tensor] = {}
        self.reset()

    def train(self, mode: bool = True) -> "MikasaOctoPolicy":
        """Set the mode; the text encoder stays frozen."""
        super().train(mode)
        self.language.eval()
        return self

    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Load weights; what was computed from others is forgotten."""
        self._prompts.clear()
        self._readouts.clear()
        return super().load_state_dict(*args, **kwargs)

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return what is trained; decay is for kernels alone, as in the original."""
        kernels: list[Tensor] = []
        others: list[Tensor] = []
        for name, parameter in self.named_parameters():
            if parameter.requires_grad:
                (kernels if is_kernel(name) else others).append(parameter)
        return [{"params": kernels}, {"params": others, "weight_decay": 0.0}]

    def reset(self) -> None:
        """Forget what lerobot's own loop has shown."""
        self._shown: deque[dict[str, Tensor]] = deque(maxlen=self.config.window)
        self._queue: deque[Tensor] = deque()

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of training samples; draws from torch's global generator."""
        readout_BWD = self._remembered(batch) if self.config.remember_readouts else self._readout(batch)
        targets = self._targets(batch)
        sizes = self.network.head.sizes
        draws = draw(sizes, targets.step_mask.shape, readout_BWD.device)
        loss = self.network.head.loss(readout_BWD, targets, draws)
        return loss, {}

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], noise: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        """Return (B, chunk, action), normalised, of images (B, W, 3, H, W') and tokens of the instruction.

        `noise` is (B, *config.noise_shape); None: from torch's global generator.
        """
        self.eval()
        readout_BD = self._readout(batch)[:, -1]
        if noise is None:
            noise = torch.randn(len(readout_BD), *self.config.noise_shape, device=readout_BD.device)
        return self.network.head.sample(readout_BD, noise.to(readout_BD))

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, action) for lerobot's own loop, which shows every frame; each becomes history."""
        self._shown.append({key: batch[key] for key in self.config.cameras.values()})
        if not self._queue:
            n_missing = self.config.window - len(self._shown)
            frames = [self._shown[0]] * n_missing + list(self._shown)
            window = {key: torch.stack([frame[key] for frame in frames], dim=1) for key in frames[0]}
            is_pad = torch.arange(self.config.window) < n_missing
            pads = {f"{key}_is_pad": is_pad.expand(len(x), -1).to(x.device) for key, x in window.items()}
            chunk = self.predict_action_chunk({**batch, **window, **pads})
            self._queue.extend(chunk[:, : self.config.n_action_steps].unbind(dim=1))
        return self._queue.popleft()

    def _readout(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return (B, W, D); without gradients where the trunk is frozen."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.config.trained != "heads"):
            return self.network.transformer(self._window(batch)).readout_BWD  # type: ignore[no-any-return]

    def _remembered(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return the readouts of training frames; those of a frame are computed once."""
        if not self.training:
            return self._readout(batch)
        rows = [int(index) for index in batch[INDEX_KEY].reshape(-1).tolist()]
        new = [place for place, row in enumerate(rows) if row not in self._readouts]
        if new:
            some = {key: x[new] for key, x in batch.items() if isinstance(x, Tensor) and len(x) == len(rows)}
            for place, readout in zip(new, self._readout(some), strict=True):
                self._readouts[rows[place]] = readout.cpu()
        return torch.stack([self._readouts[row] for row in rows]).to(self.network.head.frequencies.device)

    def _window(self, batch: Mapping[str, Tensor]) -> Window:
        step_mask = ~_needed(batch, f"{next(iter(self.config.cameras.values()))}_is_pad")
        images = {
            camera: self._images(camera, _needed(batch, field))
            for camera, field in self.config.cameras.items()
        }
        language_BLD = self._prompts(
            self.language,
            _needed(batch, OBS_LANGUAGE_TOKENS),
            _needed(batch, OBS_LANGUAGE_ATTENTION_MASK).bool(),
        )
        return Window(
            images=images,
            image_mask={camera: torch.ones_like(step_mask) for camera in images},
            step_mask=step_mask,
            language_BLD=language_BLD.to(self.network.transformer.language_positions.dtype),
            language_mask=torch.ones(len(step_mask), dtype=torch.bool, device=step_mask.device),
        )

    def _images(self, camera: str, images: Tensor) -> Tensor:
        """Return images (B, W, 3, px, px) in levels, from (B, W, 3, H, W') in [0, 1]."""
        px, changes = self.config.image_px[camera], self.config.augmentation(camera)
        levels = (images * MAX_LEVEL).round()
        if self.config.augment and self.training:
            return augment(resize_lanczos3(levels, Size(px, px)), changes)
        area = changes.centre_area if self.config.augment else 1.0
        return resize_and_centre_crop(levels, Size(px, px), area)

    def _targets(self, batch: Mapping[str, Tensor]) -> Targets:
        """Return a chunk for each step of the window.

        The original counts the first of the repeated actions after the episode's end, and no further one:
        octo/data/traj_transforms.py:84 at 241fb3514b7c40957a86d869fecb7c7fc353f540.
        """
        chunk = self.config.chunk_size
        is_pad = _needed(batch, ACTION_PADDING_KEY)
        counts = ~is_pad
        counts[:, 1:] |= is_pad[:, 1:] & ~is_pad[:, :-1]
        actions = _needed(batch, ACTION_KEY).unfold(1, chunk, 1).transpose(-1, -2)
        mask = counts.unfold(1, chunk, 1)[..., None].expand(actions.shape)
        step_mask = ~is_pad[:, : self.config.window]
        return Targets(actions=actions, action_mask=mask, step_mask=step_mask)


def _needed(batch: Mapping[str, Tensor], key: str) -> Tensor:
    if key not in batch:
        shown = ", ".join(sorted(batch))
        raise SpecMismatchError(f"'{TYPE}' needs '{key}' in its batch, found {shown}.")
    return batch[key]
