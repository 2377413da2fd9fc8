"""SmolVLA, π0 and π0.5 with memory, as LeRobot policies: lerobot's own classes with small additions."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar  # lerobot is untyped

import torch
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from torch import Tensor

from vla_eval.errors import SpecMismatchError
from vla_eval.models.shared.earlier_frames import SEGMENT_PADDING_KEY, mask_field
from vla_eval.models.vla_memory.configuration_vla_memory import (
    MikasaPI0Config,
    MikasaPI05Config,
    MikasaSmolVLAConfig,
)
from vla_eval.models.vla_memory.memory_tokens import (
    CatchesPrefix,
    MemoryTokens,
    TakesTokens,
    TokenMemory,
    extend,
)


class RemembersMixin:
    """What the three have in common; with tokens they remember. Comes before lerobot's class."""

    new_in_finetuning = ("memory_tokens.",)
    remembers_singly = True
    """`remember` takes one frame per episode, (B, …), as `predict_action_chunk` does."""
    backbone_name = "paligemma_with_expert"
    config: Any
    model: Any

    def __init__(self, config: Any, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)  # type: ignore[call-arg]  # of lerobot's class
        if not config.memory_tokens:
            return
        pair = self.backbone()
        width = int(getattr(pair, "paligemma", pair).config.text_config.hidden_size)
        self.memory_tokens = MemoryTokens(config.memory_tokens, width)
        extend(self.model, TakesTokens)
        extend(self.backbone(), CatchesPrefix)
        self.remember, self.begin_memory = self._remember, self._begin_memory
        self.memory_tokens.to(config.device)

    def backbone(self) -> Any:
        """Return lerobot's pair of language model and action expert."""
        return getattr(self.model, self.backbone_name)

    def one_denoising_step(self) -> contextlib.AbstractContextManager[dict[str, Any]]:
        """Return further arguments of an inference of which only the prefix is of interest."""
        return contextlib.nullcontext({"num_steps": 1})

    def forward(self, batch: dict[str, Tensor], **kwargs: Any) -> tuple[Tensor, dict[str, Any]]:
        """Return the loss, as lerobot's does; with tokens, of a batch in segments, (B, T, …)."""
        self._check(batch)
        if not self.config.memory_tokens:
            return super().forward(batch, **kwargs)  # type: ignore[misc,no-any-return]
        return self._loss_of_segments(batch)

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], memory: TokenMemory | None = None, **kwargs: Any
    ) -> Tensor:
        """Return (B, chunk, action); with tokens, `memory` is what `remember` returned for this frame."""
        self._check(batch)
        if (memory is None) != (not self.config.memory_tokens):
            raise ValueError(f"'{self.config.type}': memory tokens come from what `remember` returned")
        with self._given(None if memory is None else memory.read):
            chunk: Tensor = super().predict_action_chunk(batch, **kwargs)  # type: ignore[misc]
        return chunk

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Refuse: lerobot's own loop does not keep earlier frames."""
        raise SpecMismatchError(
            f"a policy of type '{self.config.type}' is shown earlier frames by this package's loop; "
            "lerobot's own does not keep them. Evaluate it with `mikasa-vla eval`."
        )

    def _begin_memory(self, n_episodes: int) -> TokenMemory:
        tokens = self.memory_tokens.begin(n_episodes).detach().clone()
        n_shown = torch.zeros(n_episodes, dtype=torch.long, device=tokens.device)
        return TokenMemory(n_shown, tokens, tokens.clone())

    @torch.no_grad()
    def _remember(self, batch: dict[str, Tensor], memory: TokenMemory | None) -> TokenMemory:
        """Return the memory after one frame per episode; it writes at every `token_stride`-th frame."""
        self._check(batch)
        if memory is None:
            memory = self._begin_memory(len(batch["observation.state"]))
        is_due = memory.n_shown % self.config.token_stride == 0
        before = memory.written
        after = before
        if is_due.any():
            with self._given(before), self.one_denoising_step() as few:
                super().predict_action_chunk(batch, **few)  # type: ignore[misc]
                after = self.memory_tokens(before, self._outputs())
        return TokenMemory(memory.n_shown + 1, before, torch.where(is_due[:, None, None], after, before))

    def _loss_of_segments(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Return the mean over samples of each one's mean loss over its segments that have a gradient."""
        real = ~batch[SEGMENT_PADDING_KEY]
        n_segments = real.shape[1]
        with_gradient = n_segments - self.config.token_segments
        tokens = self.memory_tokens.begin(len(real))
        losses, counted = [], []
        for segment in range(int(real.any(dim=0).to(torch.uint8).argmax()), n_segments):
            frame = {key: _segment(values, segment) for key, values in batch.items()}
            in_loss = segment >= with_gradient
            with torch.set_grad_enabled(in_loss and torch.is_grad_enabled()), self._given(tokens):
                loss, _ = super().forward(frame, reduction="none")  # type: ignore[misc]
                written = self.memory_tokens(tokens, self._outputs())
            begun = real[:, segment]
            tokens = torch.where(begun[:, None, None], written, tokens)
            if in_loss:
                losses.append(loss * begun)
                counted.append(begun)
        per_sample = torch.stack(losses).sum(dim=0) / torch.stack(counted).sum(dim=0)
        last = torch.stack(losses[-1:]).mean()
        return per_sample.mean(), {"loss_of_last_segment": float(last.detach())}

    @contextlib.contextmanager
    def _given(self, tokens: Tensor | None) -> Iterator[None]:
        """Let the prefix end with these tokens within the context; nothing of a pass is kept after it."""
        if tokens is None:
            yield
            return
        self.model.given = tokens
        try:
            yield
        finally:
            self.model.given = self.backbone().prefix = None

    def _outputs(self) -> Tensor:
        prefix: Tensor = self.backbone().prefix
        return prefix[:, -self.config.memory_tokens :]

    def _check(self, batch: dict[str, Tensor]) -> None:
        expected = [name for key in self.config.memory_fields for name in (key, mask_field(key))]
        missing = [name for name in expected if name not in batch]
        if missing:
            raise SpecMismatchError(
                f"a policy of type '{self.config.type}' expects earlier frames in {', '.join(missing)}, "
                "found none. Train and evaluate it with `mikasa-vla`, which adds them."
            )


class _MasksPlaces(RemembersMixin):
    """Of the π0 family, which knows no mask of a single sample's image."""

    def _preprocess_images(self, batch: dict[str, Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Return images and masks, as lerobot's does; a place without a frame is masked."""
        images, masks = super()._preprocess_images(batch)  # type: ignore[misc]
        present: Sequence[str] = [key for key in self.config.image_features if key in batch]
        for index, key in enumerate(present):
            own = batch.get(mask_field(key))
            if own is not None:
                masks[index] = own.to(masks[index])
        return images, masks


class MikasaPI0Policy(_MasksPlaces, PI0Policy):  # type: ignore[misc]  # lerobot is untyped
    """π0 with memory."""

    config_class: ClassVar[Any] = MikasaPI0Config
    name = "mikasa_pi0"


class MikasaPI05Policy(_MasksPlaces, PI05Policy):  # type: ignore[misc]  # lerobot is untyped
    """π0.5 with memory."""

    config_class: ClassVar[Any] = MikasaPI05Config
    name = "mikasa_pi05"


class MikasaSmolVLAPolicy(RemembersMixin, SmolVLAPolicy):  # type: ignore[misc]  # lerobot is untyped
    """SmolVLA with memory."""

    config_class: ClassVar[Any] = MikasaSmolVLAConfig
    name = "mikasa_smolvla"
    backbone_name = "vlm_with_expert"

    @contextlib.contextmanager
    def one_denoising_step(self) -> Iterator[dict[str, Any]]:
        """See above; SmolVLA reads the number from its configuration."""
        usual = self.config.num_steps
        self.config.num_steps = 1
        try:
            yield {}
        finally:
            self.config.num_steps = usual


def _segment(values: Any, segment: int) -> Any:
    """Return a field of one segment, (B, …) of (B, T, …); anything else is of the whole sample."""
    return values[:, segment] if isinstance(values, Tensor) and values.ndim > 1 else values
