"""`policies/*.yaml`: which code and which weights, under one name."""

from dataclasses import dataclass, field
from typing import Any

from vla_eval.bounds import (
    MAX_PROCESSES,
    MAX_STEPS,
    check_bounds,
)
from vla_eval.config.finetuning import FinetuneRecipe


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyRecipe:
    """`policies/*.yaml`: which code and which weights, under one name.

    Attributes:
        version: raised when a change of the recipe moves a success rate.
        description: one sentence.
        adapter: a name from the registry (`mikasa-vla list policies`) or `module:attr`.
        args: keyword arguments of the adapter.
        default_n_action_steps: actions executed per inference, where the evaluation names none.
        max_workers: how many workers `workers: auto` may start, since each loads the policy.
        needs_candidates: the policy makes no sense for a task without candidates; such a pair is left out.
        finetune: how weights for it are trained; None for policies that have nothing to train.
    """

    version: int
    description: str
    adapter: str
    args: dict[str, Any] = field(default_factory=dict)  # Any: whatever the adapter takes
    default_n_action_steps: int = 1
    max_workers: int | None = None
    needs_candidates: bool = False
    finetune: FinetuneRecipe | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_bounds(self, {"default_n_action_steps": (1, MAX_STEPS), "max_workers": (1, MAX_PROCESSES)})
