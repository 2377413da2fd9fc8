"""What our policies on whole episodes share: memory from frame to frame, a queue of actions. No network."""

import abc
from collections import deque
from typing import Any, ClassVar  # lerobot is untyped

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from vla_eval.features import ACTION_KEY, STATE_KEY
from vla_eval.models.episodes.config import EpisodeConfig
from vla_eval.models.episodes.memory import Memory
from vla_eval.models.episodes.samples import SAME_ACTION, Episodes, episodes_of
from vla_eval.models.episodes.sentence import TASK_KEY


class EpisodePolicy(PreTrainedPolicy):  # type: ignore[misc]  # lerobot is untyped
    """A policy that predicts chunks from a frame and, if it has `remember`, from the frames before."""

    config_class: ClassVar[Any] = EpisodeConfig
    name: ClassVar[str] = "mikasa_episodes"  # lerobot asks every class for a name; each policy has its own
    config: EpisodeConfig
    draws_nothing = True

    def __init__(self, config: EpisodeConfig) -> None:
        super().__init__(config)
        config.validate_features()
        if config.erase_warmup_episodes:
            self.register_buffer("n_trained", torch.zeros((), dtype=torch.int64))

    def samples(
        self, batch: dict[str, Tensor], *, same_action: float = SAME_ACTION, each_motion: bool = False
    ) -> Episodes:
        """Return the steps of a batch to train on, see `episodes_of`; training counts the samples."""
        config, may_stay = self.config, 1.0
        if self.training and config.erase_warmup_episodes:
            may_stay = min(1.0, int(self.n_trained) / config.erase_warmup_episodes) ** 2
            self.n_trained += len(batch[ACTION_KEY])
        return episodes_of(
            batch,
            config,
            training=self.training,
            same_action=same_action,
            may_stay=may_stay,
            each_motion=each_motion,
        )

    def declare_memory(self, begin: Any, *, remembers: bool) -> None:
        """Give the policy the methods of one that remembers; `begin` makes the memory of so many episodes."""
        self._remembers = remembers
        if remembers:
            self.remember, self.begin_memory = self._remember, begin
        self.reset()

    def get_optim_params(self) -> Any:
        """Return all parameters."""
        return self.parameters()

    def reset(self) -> None:
        """Forget what lerobot's own loop has shown."""
        self._shown: Memory | None = None
        self._queue: deque[Tensor] = deque()

    @abc.abstractmethod
    def _remember(self, batch: dict[str, Tensor], memory: Any) -> Any:
        """Return the memory after the frames (B, T, …) of a batch; None: an episode begins."""

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, action) for lerobot's own loop, which shows every frame and resets between episodes."""
        if self._remembers:
            frames: dict[str, Any] = {TASK_KEY: batch.get(TASK_KEY)}
            frames |= {key: batch[key][:, None] for key in (STATE_KEY, *self.config.image_features)}
            self._shown = self._remember(frames, self._shown)
        if not self._queue:
            chunk = self.predict_action_chunk(batch, self._shown)
            self._queue.extend(chunk[:, : self.config.n_action_steps].unbind(dim=1))
        return self._queue.popleft()

    def check_shown(self, memory: Any) -> None:
        """Raise `ValueError` if a policy with a memory is asked without one."""
        if self._remembers and memory is None:
            raise ValueError(f"'{self.name}' with a memory needs what `remember` returned for this frame")
