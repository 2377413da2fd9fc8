"""Learn from demonstrations that the expert gives as the training begins, not from rewards.

A class like the library's algorithms, so that everything around a training is the same: recipes, folders,
checkpoints, resuming. A step is a gradient step. Demonstrations and the order in which they are read are
functions of the run seed.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self  # the library's callbacks

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from vla_eval.agents.expert import Demonstration, exchanges, order
from vla_eval.agents.vector_env import SlotsEnv
from vla_eval.policies.agents.imitator import exchanged
from vla_eval.strict.bounds import require

LOG_EVERY_STEPS = 20
ARGUMENTS = "train_agent.arguments"


@dataclass(frozen=True, slots=True, kw_only=True)
class Demonstrations:
    """All of them, padded to the longest."""

    inputs: Tensor  # (N, T, inputs) float32
    actions: Tensor  # (N, T, A) float32, in the agent's action space
    is_step: Tensor  # (N, T) bool; False: padding
    meant: Tensor  # (N, T) int64
    n_steps: Tensor  # (N,) of each

    @classmethod
    def of(cls, episodes: Sequence[Demonstration]) -> Self:
        """Put episodes together."""
        n_steps = torch.tensor([len(one.inputs) for one in episodes])
        padded = [
            pad_sequence([torch.from_numpy(part) for part in parts], batch_first=True)
            for parts in zip(*episodes, strict=True)
        ]
        inputs, actions, meant = padded
        return cls(
            inputs=inputs,
            actions=actions,
            meant=meant,
            is_step=torch.arange(inputs.shape[1]) < n_steps[:, None],
            n_steps=n_steps,
        )


class Imitation(BaseAlgorithm):
    """Behaviour cloning of whole episodes by the scripted expert of the task.

    Args:
        policy: the network's class, `policies.agents.imitator.CoreNetwork`.
        env: the environments, where the expert acts.
        learning_rate: of AdamW.
        demonstrations: how many there are; of a robot's, those that succeed.
        action_noise: what an arm is pushed by while the expert acts, as in recorded datasets; the expert's
            own action is learned.
        meant_weight: of the cross-entropy of the candidate that the expert touched next, beside the squared
            errors of its actions: what an arm does once it moves tells where it goes, and needs no memory.
        exchange_share: in so many of the demonstrations of a step, the candidates exchange what they are, as
            drawn, so that what is shown cannot be learned by heart.
        batch_size: demonstrations per step.
        weight_decay: of AdamW.
        max_grad_norm: longer gradients are cut to it.
        policy_kwargs: fields of the network.
        device: where it learns.
    """

    def __init__(
        self,
        policy: type[Any],
        env: SlotsEnv,
        learning_rate: float = 1e-3,
        demonstrations: int = 250,
        action_noise: float = 0.0,
        meant_weight: float = 0.02,
        exchange_share: float = 0.0,
        batch_size: int = 32,
        weight_decay: float = 0.0,
        max_grad_norm: float = 1.0,
        policy_kwargs: dict[str, Any] | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(
            policy, env, learning_rate, policy_kwargs=policy_kwargs, device=device, support_multi_env=True
        )
        for name, count in (("demonstrations", demonstrations), ("batch_size", batch_size)):
            require(type(count) is int and count >= 1, f"{ARGUMENTS}.{name}", count, "a whole number ≥ 1")
        weights = {"action_noise": action_noise, "meant_weight": meant_weight, "weight_decay": weight_decay}
        for name, size in weights.items():
            require(0 <= size < math.inf, f"{ARGUMENTS}.{name}", size, "a number ≥ 0")
        require(0 <= exchange_share <= 1, f"{ARGUMENTS}.exchange_share", exchange_share, "0 to 1")
        require(max_grad_norm > 0, f"{ARGUMENTS}.max_grad_norm", max_grad_norm, "a number above 0")
        assert env.expert is not None
        self._expert = env.expert
        self.batch_size, self.n_demonstrations = batch_size, demonstrations
        self.action_push, self._weight_decay, self._max_grad_norm = action_noise, weight_decay, max_grad_norm
        self._meant_weight, self._exchange_share = meant_weight, exchange_share
        self._demonstrations: Demonstrations | None = None
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.policy = self.policy_class(
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        ).to(self.device)
        self.optimizer = torch.optim.AdamW(
            self.policy.parameters(), lr=self.lr_schedule(1.0), weight_decay=self._weight_decay
        )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "optimizer"], []

    def learn(
        self, total_timesteps: int, callback: Any, log_interval: int = 1, reset_num_timesteps: bool = True
    ) -> Self:
        """Take so many gradient steps; stops when the callback says so."""
        del log_interval, reset_num_timesteps
        callback = self._init_callback(callback, progress_bar=False)
        goal = self.num_timesteps + total_timesteps
        callback.on_training_start(locals(), globals())
        if self._demonstrations is None:
            for _ in self._collect():
                if not callback.on_step():
                    return self
        assert self._demonstrations is not None
        self.policy.set_training_mode(True)
        losses: list[float] = []
        while self.num_timesteps < goal:
            losses.append(self._step(self._demonstrations))
            self.num_timesteps += 1
            if not callback.on_step():
                break
            if self.num_timesteps % LOG_EVERY_STEPS == 0 or self.num_timesteps == goal:
                self.logger.record("train/loss", float(np.mean(losses)))
                self.logger.dump(step=self.num_timesteps)
                losses.clear()
        return self

    def _collect(self) -> Iterator[None]:
        """Let the expert act until all are there, a batch at a time."""
        found: list[Demonstration] = []
        for batch in self._expert.demonstrations(self.n_demonstrations, noise=self.action_push):
            found += batch
            yield
        self._demonstrations = Demonstrations.of(found)
        self.policy.set_statistics(self._demonstrations.inputs[self._demonstrations.is_step])

    def _step(self, given: Demonstrations) -> float:
        """Take one gradient step; return its loss, the mean over steps of the demonstrations read."""
        self._update_learning_rate(self.optimizer)
        chosen = torch.from_numpy(self._chosen(len(given.n_steps)))
        longest = int(given.n_steps[chosen].max())
        inputs, actions, meant, is_step = (
            part[chosen, :longest].to(self.device)
            for part in (given.inputs, given.actions, given.meant, given.is_step)
        )
        if self._exchange_share:
            orders = exchanges(
                self._expert.run_seed,
                self.num_timesteps,
                n_demonstrations=len(chosen),
                n_candidates=self.policy.n_places,
                share=self._exchange_share,
            )
            inputs, meant = exchanged(inputs, meant, torch.from_numpy(orders).to(self.device))
        answers, _ = self.policy(inputs, self.policy.core.begin(len(chosen)))
        errors = self.policy.errors(answers, actions, meant, meant_weight=self._meant_weight)
        loss = errors[is_step].mean()
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self._max_grad_norm)
        self.optimizer.step()
        self._n_updates += 1
        return float(loss.detach())

    def _chosen(self, n: int) -> np.ndarray[Any, Any]:
        """Return the demonstrations of this step: none is read twice in a pass."""
        size = min(self.batch_size, n)
        pass_number, place = divmod(self.num_timesteps, n // size)
        return order(self._expert.run_seed, pass_number, n)[place * size : (place + 1) * size]
