"""How a policy's new chunk joins the one under way: what its network is given of what is committed.

A network works on normalised actions. What is committed is in the environment's units, so the checkpoint's
own preprocessor normalises it, as it did the actions of training, and its postprocessor has to give it back.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self  # lerobot is untyped

import numpy as np
import torch
from lerobot.configs import RTCAttentionSchedule
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from torch import Tensor

from vla_eval.checkpoints.loading import LoadedPolicy
from vla_eval.chunking import ChunkingSpec, RtcSettings
from vla_eval.core import CommittedActions
from vla_eval.errors import InvalidActionError, SpecMismatchError
from vla_eval.features import ACTION_KEY
from vla_eval.models.shared.prefix import Prefix

ROUND_TRIP_TOLERANCE = 1e-3
"""By how much an action may change on its way through normalisation and back; the actions are about 1."""


class Joining(Protocol):
    """What is particular to one way to join chunks."""

    def arguments(self, committed: CommittedActions, normalised: Tensor) -> dict[str, Any]:
        """Return the arguments of `predict_action_chunk` for rows with the same committed steps.

        `normalised` (B, N, A): what is committed in each row, N ≥ 1.
        """


class Guided:
    """Real-time chunking by LeRobot's `RTCProcessor`: the denoising is guided towards what is committed."""

    def __init__(
        self, loaded: LoadedPolicy, settings: RtcSettings, *, policy: str, is_compiled: bool
    ) -> None:
        supports = getattr(loaded.policy, "supports_rtc", None)
        if not callable(supports) or not supports():
            raise SpecMismatchError(
                f"policy '{policy}' (type '{loaded.config.type}') cannot be guided, which chunking.mode=rtc "
                "asks for: expected a policy that makes chunks by flow matching. Use another mode."
            )
        if is_compiled:
            raise SpecMismatchError(
                f"policy '{policy}': a compiled network is not guided. Leave out `compile`, or "
                "chunking.mode=rtc."
            )
        self._execution_horizon = settings.execution_horizon
        loaded.config.rtc_config = RTCConfig(
            prefix_attention_schedule=RTCAttentionSchedule(settings.prefix_attention_schedule.upper()),
            max_guidance_weight=settings.max_guidance_weight,
            execution_horizon=settings.execution_horizon,
        )
        loaded.policy.init_rtc_processor()

    def arguments(self, committed: CommittedActions, normalised: Tensor) -> dict[str, Any]:
        """Return what LeRobot's flow policies take."""
        return {
            "inference_delay": committed.n_frozen,
            "prev_chunk_left_over": normalised,
            "execution_horizon": self._execution_horizon,
        }


class Prefixed:
    """A policy that was trained with prefixes is given the frozen rows as they are."""

    def __init__(self, loaded: LoadedPolicy, *, policy: str) -> None:
        self._policy = policy
        self._most_steps = int(getattr(loaded.config, "prefix_steps", 0))
        self._chunk_size = int(loaded.config.chunk_size)
        if not self._most_steps:
            raise SpecMismatchError(
                f"policy '{policy}' (type '{loaded.config.type}') was not trained to continue a prefix, "
                "which chunking.mode=prefix asks for. Train it with finetune.policy.prefix_steps "
                "(docs/real_time.md)."
            )

    def arguments(self, committed: CommittedActions, normalised: Tensor) -> dict[str, Any]:
        """Return the prefix; refuse one that is longer than those of training."""
        n_frozen = committed.n_frozen
        if n_frozen > self._most_steps:
            raise InvalidActionError(
                f"policy '{self._policy}': {n_frozen} steps are committed, and it was trained with prefixes "
                f"of at most {self._most_steps}. Lower the delay, or train it with a larger prefix_steps."
            )
        n_rows, n_committed, n_dims = normalised.shape
        actions = normalised.new_zeros(n_rows, self._chunk_size, n_dims)
        actions[:, :n_committed] = normalised
        mask = (torch.arange(self._chunk_size, device=normalised.device) < n_frozen).expand(n_rows, -1)
        return {"prefix": Prefix(actions, mask)} if n_frozen else {}


def joining_of(
    loaded: LoadedPolicy, chunking: ChunkingSpec, *, policy: str, is_compiled: bool
) -> Joining | None:
    """Return how a policy's chunks join in the mode of an evaluation; None: they do not.

    Raises:
        SpecMismatchError: the policy cannot do what the mode asks for.
    """
    if not chunking.execution.commits:
        return None
    if chunking.execution.is_guided:
        return Guided(loaded, chunking.rtc, policy=policy, is_compiled=is_compiled)
    return Prefixed(loaded, policy=policy)


@dataclass(frozen=True, slots=True, kw_only=True)
class Committed:
    """What is committed in the rows of one pass, of which all have as many steps."""

    steps: CommittedActions  # of one row: its numbers of steps are those of all
    actions: Tensor  # (B, N, A), in the environment's units

    @classmethod
    def of(cls, rows: Sequence[CommittedActions | None]) -> Self | None:
        """Return what is committed in each row; None if nothing is."""
        told = [row for row in rows if row is not None and len(row.actions)]
        if not told:
            return None
        return cls(steps=told[0], actions=torch.from_numpy(np.stack([row.actions for row in told])))

    def arguments(
        self, batch: dict[str, Any], joining: Joining, loaded: LoadedPolicy, *, policy: str
    ) -> dict[str, Any]:
        """Take the normalised actions out of a preprocessed batch, and return what the network gets.

        Raises:
            InvalidActionError: the checkpoint does not give actions back that it has normalised.
        """
        normalised = batch.pop(ACTION_KEY)
        back = loaded.postprocessor(normalised.clone()).detach().to("cpu", torch.float32)
        wrong = (back - self.actions).abs() > ROUND_TRIP_TOLERANCE * self.actions.abs().clamp(min=1.0)
        if bool(wrong.any()):
            row, step, dim = (int(i) for i in wrong.nonzero()[0])
            raise InvalidActionError(
                f"policy '{policy}': what is committed cannot be given to its network: the action "
                f"{self.actions[row, step, dim]:.4g} (dimension {dim}) comes back as "
                f"{back[row, step, dim]:.4g} from its processors. They normalise actions in another way than "
                "they undo it; use a mode that tells the policy nothing."
            )
        return joining.arguments(self.steps, normalised)
