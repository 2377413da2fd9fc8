"""Ask a policy for one action per step; each episode has its own instance of the policy's queues."""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple  # lerobot is untyped

from torch import Tensor

from vla_eval.models.families import family_of


class Step(NamedTuple):
    """A chunk (B, 1, D) of one action, and the policy's queues after it."""

    action: Tensor
    queues: Mapping[str, Any]


def select_step(policy: Any, batch: dict[str, Any], queues: Mapping[str, Any] | None) -> Step:
    """Return the next action for the newest frame (B, …); `queues` stay as they are; None: it begins."""
    owner = policy.select_action.__self__  # of a policy with a LoRA adapter, not what is around it
    for name, value in (queues or {}).items():
        setattr(owner, name, copy.deepcopy(value))
    action: Tensor = owner.select_action(batch)
    kept = {name: getattr(owner, name) for name in family_of(owner.config.type).queues}
    return Step(action.unsqueeze(1), kept)
