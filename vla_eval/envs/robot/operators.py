"""What the environment asks of the person beside the arm; and the keys, a row each.

Knows nothing of terminals, robots or policies: an operator knows what to place, not what moves the arm.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from vla_eval.tasks.real_stages import COLORS, Trial

NEXT, PICKED, DONE, ABORT = "next", "picked", "done", "abort"
HOLD = "hold"


class Key(NamedTuple):
    """A key and what it says."""

    character: str
    means: str  # `red`, `green`, `blue`: touched; or one of the words above
    words: str


KEYS = (
    Key(" ", HOLD, "dead man's key: hold it while the arm may move"),
    Key("\n", NEXT, "what was asked is done"),
    *(Key(color[0], color, f"the {color} cube was touched") for color in COLORS),
    Key("p", PICKED, "the right cube was picked"),
    Key("d", DONE, "nothing more will happen: end the episode"),
    Key("x", ABORT, "stop: the arm holds still, and the episode is run again"),
)
MEANINGS: Mapping[str, str] = {key.character: key.means for key in KEYS}


class Operator(Protocol):
    """A person beside the arm, or a script in their place."""

    def prepare(self, trial: Trial) -> None:
        """Have the table set for the first phase of a trial; errors as `ask`."""

    def ask(self, words: str) -> None:
        """Ask for something, and return once it is confirmed.

        Raises:
            OperatorError: it was refused, or there was no answer.
        """

    def tell(self, words: str) -> None:
        """Say something that needs no answer."""

    def pressed(self) -> Sequence[str]:
        """Return what was pressed since the last call, as `Key.means`, without the dead man's key."""

    def until_held(self) -> None:
        """Return once the dead man's key is held; errors as `ask`."""

    def lets_move(self) -> bool:
        """Whether the dead man's key is held, so that the arm may move."""
