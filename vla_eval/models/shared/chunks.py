"""What policies share that predict chunks from images and a prompt: lerobot's own loop, padding, prompts."""

from collections import deque
from typing import Any  # lerobot is untyped

import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from vla_eval.errors import SpecMismatchError, TrainingError
from vla_eval.models.shared.images import MAX_LEVEL


class PromptedChunks:
    """For a `PreTrainedPolicy` whose configuration has a chunk, a longest prompt and defaults of LoRA."""

    name: str
    config: Any
    parameters: Any
    predict_action_chunk: Any

    def get_optim_params(self) -> list[Tensor]:
        """Return the parameters that are trained."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def reset(self) -> None:
        """Forget what lerobot's own loop has not executed yet."""
        self._queue: deque[Tensor] = deque()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, action) for lerobot's own loop: the first `n_action_steps` of each chunk in turn."""
        if not self._queue:
            chunk = self.predict_action_chunk(batch)
            self._queue.extend(chunk[:, : self.config.n_action_steps].unbind(dim=1))
        return self._queue.popleft()

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """Return what LoRA trains; lerobot asks for it."""
        return self.config.lora_defaults()  # type: ignore[no-any-return]  # lerobot is untyped

    def _prompt(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return tokens of the prompts and their mask, (B, tokens) each; raise if one is too long."""
        ids = batch[OBS_LANGUAGE_TOKENS]
        if ids.shape[1] > self.config.prompt_max_tokens:
            raise SpecMismatchError(
                f"'{self.name}': a prompt has {ids.shape[1]} tokens, expected at most "
                f"{self.config.prompt_max_tokens} (prompt_max_tokens)."
            )
        return ids, batch[OBS_LANGUAGE_ATTENTION_MASK]

    def _levels(self, batch: dict[str, Tensor], name: str) -> Tensor:
        """Return an image (B, 3, H, W) of the batch, which has to be there, in levels, 0 to 255."""
        if name not in batch:
            raise SpecMismatchError(f"'{self.name}': the batch has no image '{name}'.")
        return (batch[name].float() * MAX_LEVEL).round()

    def _counts(self, is_pad: Tensor | None, actions: Tensor) -> Tensor:
        """Return (B, chunk) float, 0 beyond an episode's end; raise if these may not be left out."""
        if is_pad is None:
            return torch.ones(actions.shape[:2], device=actions.device)
        if not self.config.do_mask_loss_for_padding and bool(is_pad.any()):
            raise TrainingError(
                f"'{self.name}': a chunk goes beyond its episode's end. Train with a sampler that leaves out "
                f"the last drop_n_last_frames ({self.config.drop_n_last_frames}) frames, as `mikasa-vla "
                "finetune` does, or set do_mask_loss_for_padding."
            )
        return (~is_pad).float()
