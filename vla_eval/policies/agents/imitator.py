"""The network that imitates: numbers in, one of the cores over time, an action per step.

The cores are those of the sequence policies, so that what a core remembers can be compared between tasks
with images and tasks of a few numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any  # spaces of Gymnasium, and values of a recipe

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.core import FloatArray
from vla_eval.errors import RecipeError, check_names
from vla_eval.models.sequence.core import CoreMemory
from vla_eval.models.sequence.cores import make_core
from vla_eval.models.sequence.heads import Gated
from vla_eval.models.sequence.sizes import CORES, MANY, options_of
from vla_eval.policies.agents.observing import VECTOR
from vla_eval.strict.bounds import check_bounds
from vla_eval.strict.decoding import decode

NETWORK = "train_agent.network"
# m, rad, or what inputs are in. What hardly varies where the expert acts would else be loud where an arm is
# pushed aside.
SMALLEST = 0.05
LARGEST = 10.0  # standard deviations: what lies beyond is not like the demonstrations


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreSizes:
    """The fields `train_agent.network` of an imitator; what they mean: `models.sequence.core`."""

    core: str = "gru"
    width: int = 64
    layers: int = 1
    heads: int = 4
    context_steps: int = 20  # of a segment, or of the window
    dropout: float = 0.0
    core_options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_bounds(
            self,
            {
                **dict.fromkeys(("width", "layers", "heads", "context_steps"), (1, MANY)),
                "dropout": (0, 0.999),
            },
            prefix=f"{NETWORK}.",
        )
        check_names("core", [self.core], CORES, where=f"{NETWORK}.core")
        row = CORES[self.core]
        if row.heads_divide and self.width % self.heads:
            raise RecipeError(f"{NETWORK}.width is {self.width}, expected a multiple of heads={self.heads}.")
        if row.is_even and self.width % 2:
            raise RecipeError(f"{NETWORK}.width is {self.width}, expected an even number for '{self.core}'.")
        options_of(self.core, self.core_options)


class CoreNetwork(nn.Module):
    """Reads (B, T, inputs) and answers each step with what an action is chosen by.

    Args:
        observation: what is given: one vector, by the name `vector`.
        action: a box (answers are the action), or choices (answers are their logits, one after the other).
        lr_schedule: the library gives it; not used.
        sizes: the fields of `CoreSizes`.

    Raises:
        RecipeError: the sizes do not go together.
    """

    mean: Tensor
    scale: Tensor

    def __init__(
        self, observation: gym.spaces.Dict, action: gym.Space[Any], lr_schedule: object, **sizes: Any
    ) -> None:
        super().__init__()
        del lr_schedule
        self.sizes = decode(CoreSizes, sizes, where=NETWORK)
        self.action = action
        self.counts = _counts(action)  # of choices; none where the action is numbers
        n_inputs = int(np.prod(observation.spaces[VECTOR].shape or ()))
        n_outputs = sum(self.counts) if self.counts else int(np.prod(action.shape or ()))
        width = self.sizes.width
        # What the inputs are on the demonstrations; saved with the weights.
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("scale", torch.ones(n_inputs))
        self.read = nn.Sequential(
            nn.Linear(n_inputs, width), nn.GELU(), nn.Linear(width, width), nn.LayerNorm(width)
        )
        self.core = make_core(
            self.sizes.core,
            width=width,
            layers=self.sizes.layers,
            heads=self.sizes.heads,
            context_steps=self.sizes.context_steps,
            dropout=self.sizes.dropout,
            given=self.sizes.core_options,
        )
        # The step itself is read beside the core's answer, so that the core is free to hold what was before.
        # Products, because what was remembered often says which of the numbers in view is meant.
        self.answer = nn.Sequential(
            Gated(2 * width, width), nn.LayerNorm(width), Gated(width, width), nn.Linear(width, n_outputs)
        )

    def set_statistics(self, inputs: Tensor) -> None:
        """Normalise by mean and deviation of (N, inputs), but enlarge nothing by more than `SMALLEST`."""
        deviation, mean = torch.std_mean(inputs.double(), dim=0, correction=0)
        self.mean.copy_(mean)
        self.scale.copy_(deviation.clamp(min=SMALLEST))

    def forward(self, inputs: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """Return answers (B, T, outputs) to inputs (B, T, inputs), and the memory after the last."""
        tokens = self.read(((inputs - self.mean) / self.scale).clamp(-LARGEST, LARGEST))
        remembered, memory = self.core(tokens, memory)
        return self.answer(torch.cat([remembered, tokens], dim=-1)), memory

    def errors(self, answers: Tensor, actions: Tensor) -> Tensor:
        """Return (B, T): squared errors of actions (B, T, A), or the choices' cross-entropies, added up."""
        if not self.counts:
            return (answers - actions).square().mean(dim=-1)
        parts = zip(self._of_choices(answers), actions.long().unbind(-1), strict=True)
        found = [
            functional.cross_entropy(part.transpose(1, 2), chosen, reduction="none") for part, chosen in parts
        ]
        return torch.stack(found).sum(dim=0)

    def _of_choices(self, answers: Tensor) -> tuple[Tensor, ...]:
        """Return the logits of each choice."""
        return torch.split(answers, self.counts, dim=-1)

    def begun(self) -> Mapping[str, np.ndarray[Any, Any]]:
        """Return the memory that an episode begins with, by name."""
        begun = self.core.begin(1)
        return {f"policy/core_{index}": part.detach().numpy() for index, part in enumerate(begun)}

    def predict(
        self,
        seen: Mapping[str, FloatArray],
        *,
        state: tuple[np.ndarray[Any, Any], ...] | None,
        episode_start: np.ndarray[Any, Any],
        deterministic: bool,
    ) -> tuple[np.ndarray[Any, Any], tuple[np.ndarray[Any, Any], ...]]:
        """Return the action for one observation (a row of one), and the memory; as the library's networks."""
        assert deterministic and len(episode_start) == 1
        with torch.inference_mode():
            memory = self.core.begin(1) if state is None else tuple(torch.from_numpy(part) for part in state)
            answers, memory = self(torch.from_numpy(np.asarray(seen[VECTOR], np.float32))[None], memory)
        answer, kept = answers[:, 0], tuple(part.numpy() for part in memory)
        if not self.counts:
            assert isinstance(self.action, gym.spaces.Box)
            return np.clip(answer.numpy(), self.action.low, self.action.high), kept
        likely = [part.argmax(dim=-1) for part in self._of_choices(answer)]
        return torch.stack(likely, dim=-1).numpy(), kept

    def set_training_mode(self, mode: bool) -> None:
        """Train or answer: the library's word for it."""
        self.train(mode)


def _counts(action: gym.Space[Any]) -> list[int]:
    if isinstance(action, gym.spaces.Discrete):
        return [int(action.n)]
    return [int(n) for n in action.nvec] if isinstance(action, gym.spaces.MultiDiscrete) else []
