"""What a warm-up of a compiled network finds out. Imports no torch."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from vla_eval.specs import EnvSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class Compilation:
    """What a warm-up found out."""

    seconds: float  # it took, compilation included
    n_rows: int  # of a pass
    precision: str  # of most weights
    difference: float  # the largest |compiled - not compiled| of an action, in the action's units
    scale: float  # the largest |action|

    def note(self, policy: str) -> str:
        """Return the line that tables print."""
        return (
            f"The network of {policy} was compiled ({self.precision}, {self.n_rows} in a pass): on random "
            f"observations its actions, of at most {self.scale:.2g}, differ by at most {self.difference:.1g} "
            "from those of the network as it is"
        )


@runtime_checkable
class CompiledPolicy(Protocol):
    """A policy whose network may be compiled."""

    def warm_up(self, env: EnvSpec, sentences: Sequence[str]) -> Compilation | None:
        """Compile for these sentences, in the thread that will ask it; None: it is not to be compiled."""
