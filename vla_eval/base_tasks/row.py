"""One level of a MIKASA-Base environment as a row: what it is called, its length, its known returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal  # Any: arguments of environments

NAMESPACE = "mikasa_base/"

Memory = Literal["object", "spatial", "sequential", "capacity"]
"""The paper's four types of memory (section "Memory tasks classification")."""

Tier = Literal["diagnostic vector", "complex image"]
"""The paper's two tiers: vectors to test one mechanism in isolation; images to find out whether it holds."""

Extra = Literal["", "base", "base-3d"]
"""The extra of this package that an environment needs; none for those written again from their rules."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Mean returns that are known for a row.

    Attributes:
        random: of uniformly random actions.
        memoryless: of the best policy known that acts by the current observation alone; None where no good
            one is known: random actions are never given in its place.
        best: of the best policy known, or the maximum.
        source: where they come from, in words.
    """

    random: float | None
    memoryless: float | None
    best: float | None
    source: str

    def normalised(self, mean_return: float) -> float | None:
        """Return (R - R_memoryless) / (R_best - R_memoryless), unclipped.

        None where either is not known, and where the best is no better than the memoryless one.
        """
        if self.memoryless is None or self.best is None or self.best <= self.memoryless:
            return None
        return (mean_return - self.memoryless) / (self.best - self.memoryless)


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseTask:
    """One row of the catalogue of MIKASA-Base.

    Attributes:
        name: as in the official package, `RepeatFirstEasy-v0`; the gym id is `mikasa_base/<name>`.
        family: which of the 24 environments it is a level of.
        version: raised when a change affects a return; recorded with each run.
        entry_point: `module:Class` of the environment.
        kwargs: its arguments for this level.
        horizon_steps: the episode is truncated after so many steps, unless it has terminated.
        memory: the types of memory that the paper ascribes to it.
        tier: the paper's.
        extra: what has to be installed for it.
        description: one sentence: what is done.
        remember: one sentence: what has to be remembered, for how long.
        success: one sentence: the success rule; None where there is no natural one.
        figures: what returns are known.
        memoryless: `module:Class` of the player without memory; None where no good one is known.
        oracle: `module:Class` of the player with perfect memory or the true state.
        hides_action: what an observation means depends on the last action, which it does not show.
        is_slow: 100 episodes take an hour: `eval` and `audit` of the whole suite leave it out, and say so.
        source: upstream, pinned to a commit, and its licence.
    """

    name: str
    family: str
    version: int = 1
    entry_point: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    horizon_steps: int
    memory: tuple[Memory, ...]
    tier: Tier
    extra: Extra = ""
    description: str
    remember: str
    success: str | None
    figures: Figures
    memoryless: str | None
    oracle: str
    source: str
    hides_action: bool = False
    is_slow: bool = False

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium and the harness know it."""
        return f"{NAMESPACE}{self.name}"
