"""The network that imitates: numbers in, one of the cores over time, an action per step.

The cores are those of the sequence policies, so that what a core remembers can be compared between tasks
with images and tasks of a few numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple  # Any: spaces of Gymnasium, and values of a recipe

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.core import FloatArray
from vla_eval.errors import check_names
from vla_eval.models.cores.core import CoreMemory
from vla_eval.models.cores.cores import make_core
from vla_eval.models.cores.gated import Gated
from vla_eval.models.cores.sizes import CORES, MANY, RecurrentOptions, check_core
from vla_eval.policies.agents.observing import PLACES, VECTOR, Seen
from vla_eval.strict.bounds import check_bounds
from vla_eval.strict.decoding import decode

NETWORK = "train_agent.network"
# m, rad, or what inputs are in. What hardly varies where the expert acts would else be loud where an arm is
# pushed aside.
SMALLEST = 0.05
PLACE_M = 0.1  # the order of distances between candidates
# Of gates that keep the state, at first: at 0 half of a memory is gone after a step (docs/agents.md).
KEEP_BIAS = 3.0
LARGEST = 10.0  # standard deviations: what lies beyond is not like the demonstrations


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreSizes:
    """The fields `train_agent.network` of an imitator; what they mean: `models.cores.core`."""

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
        check_core(self.core, width=self.width, heads=self.heads, given=self.options, prefix=f"{NETWORK}.")

    @property
    def options(self) -> dict[str, Any]:
        """Options of the core: what is given, over `keep_bias` of a GRU or an LSTM."""
        recurrent = isinstance(CORES[self.core].options, RecurrentOptions)
        return {**({"keep_bias": KEEP_BIAS} if recurrent else {}), **self.core_options}


def as_inputs(seen: Seen) -> FloatArray:
    """Return what an agent is given as one vector, or a row of each: the vector, then the places, if any."""
    parts = [seen[VECTOR], *([seen[PLACES].reshape(*seen[PLACES].shape[:-2], -1)] if PLACES in seen else [])]
    inputs: FloatArray = np.concatenate(parts, axis=-1).astype(np.float32)
    return inputs


def exchanged(inputs: Tensor, meant: Tensor, orders: Tensor) -> tuple[Tensor, Tensor]:
    """Let the candidates of demonstrations exchange what they are, alike at all steps.

    Which was shown, where each lies and which is meant are exchanged together: what candidate k was is now
    the candidate whose number in its row of `orders` is k.

    Args:
        inputs: (B, T, inputs) of the observation `vector`.
        meant: (B, T); -1 stays.
        orders: (B, n) a permutation of the candidates in each row.
    """
    n_steps, n = inputs.shape[1], orders.shape[1]
    sizes = [inputs.shape[-1] - 4 * n - 1, n, 1, 3 * n]
    before, shown, due, places = torch.split(inputs, sizes, dim=-1)
    at_each = orders[:, None].expand(-1, n_steps, -1)
    shown = shown.gather(-1, at_each)
    places = places.reshape(*shown.shape, 3)
    places = places.gather(-2, at_each[..., None].expand(-1, -1, -1, 3)).flatten(-2)
    renamed = orders.argsort(dim=1).gather(1, meant.clamp(min=0))
    return torch.cat([before, shown, due, places], dim=-1), torch.where(meant < 0, meant, renamed)


class Answers(NamedTuple):
    """What the network says at each step."""

    action: Tensor  # (B, T, outputs)
    meant: Tensor | None  # (B, T, n) logits of which of n places is meant; None: there are none


class CoreNetwork(nn.Module):
    """Reads (B, T, inputs) and answers each step with what an action is chosen by.

    Args:
        observation: what is given: `vector`, and `places`, one of which may be meant.
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
        self.n_places = (
            int((observation.spaces[PLACES].shape or (0,))[0]) if PLACES in observation.spaces else 0
        )
        n_inputs = int(np.prod(observation.spaces[VECTOR].shape or ())) + 3 * self.n_places
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
            given=self.sizes.options,
        )
        # The step itself is read beside the core's answer, so that the core is free to hold what was before.
        self.decide = nn.Sequential(Gated(2 * width, width), nn.LayerNorm(width))
        if self.n_places:  # which of them is meant is decided; where it is, is in view
            self.choose, self.towards = nn.Linear(width, self.n_places), nn.Linear(3, width)
        self.answer = nn.Sequential(Gated(width, width), nn.Linear(width, n_outputs))

    def set_statistics(self, inputs: Tensor) -> None:
        """Normalise by mean and deviation of (N, inputs), with deviations of `SMALLEST` at least."""
        deviation, mean = torch.std_mean(inputs.double(), dim=0, correction=0)
        self.mean.copy_(mean)
        self.scale.copy_(deviation.clamp(min=SMALLEST))

    def forward(self, inputs: Tensor, memory: CoreMemory) -> tuple[Answers, CoreMemory]:
        """Return the answers to inputs (B, T, inputs), and the memory after the last."""
        tokens = self.read(((inputs - self.mean) / self.scale).clamp(-LARGEST, LARGEST))
        remembered, memory = self.core(tokens, memory)
        decided = self.decide(torch.cat([remembered, tokens], dim=-1))
        meant = None
        if self.n_places:
            meant = self.choose(decided)
            places = inputs[..., -3 * self.n_places :].reshape(*inputs.shape[:-1], self.n_places, 3)
            place = meant.softmax(dim=-1)[..., None, :] @ (places / PLACE_M)
            decided = decided + self.towards(place[..., 0, :])
        return Answers(self.answer(decided), meant), memory

    def errors(self, answers: Answers, actions: Tensor, meant: Tensor, *, meant_weight: float) -> Tensor:
        """Return the error of each step, (B, T).

        Args:
            answers: what the network said.
            actions: (B, T, A). Numbers have the mean of squared errors, choices the sum of cross-entropies.
            meant: (B, T) the candidate that the expert touched next; -1 where there is none.
            meant_weight: of its cross-entropy.
        """
        if self.counts:
            parts = zip(self._of_choices(answers.action), actions.long().unbind(-1), strict=True)
            found = torch.stack([_cross_entropy(part, chosen) for part, chosen in parts]).sum(dim=0)
        else:
            found = (answers.action - actions).square().mean(dim=-1)
        if answers.meant is None:
            return found
        return found + meant_weight * _cross_entropy(answers.meant, meant)

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
            answers, memory = self(torch.from_numpy(as_inputs(seen)[:, None]), memory)
        answer, kept = answers.action[:, 0], tuple(part.numpy() for part in memory)
        if not self.counts:
            assert isinstance(self.action, gym.spaces.Box)
            return np.clip(answer.numpy(), self.action.low, self.action.high), kept
        likely = [part.argmax(dim=-1) for part in self._of_choices(answer)]
        return torch.stack(likely, dim=-1).numpy(), kept

    def set_training_mode(self, mode: bool) -> None:
        """Train or answer: the library's word for it."""
        self.train(mode)


def _cross_entropy(logits: Tensor, chosen: Tensor) -> Tensor:
    """Return (B, T) of logits (B, T, n); 0 where -1 is chosen."""
    return functional.cross_entropy(logits.transpose(1, 2), chosen, reduction="none", ignore_index=-1)


def _counts(action: gym.Space[Any]) -> list[int]:
    if isinstance(action, gym.spaces.Discrete):
        return [int(action.n)]
    return [int(n) for n in action.nvec] if isinstance(action, gym.spaces.MultiDiscrete) else []
