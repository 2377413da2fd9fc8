"""Names of the parts that a plain policy may be made of, and what has to be known of them. Without torch."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreRow:
    """What has to be known of a core before it is made.

    Attributes:
        remembers: False: each step is answered alone, and the policy is shown only the last frame.
        attends: it has attention, whose heads divide the width.
    """

    remembers: bool = True
    attends: bool = False


CORES = {
    "mlp": CoreRow(remembers=False),
    "gru": CoreRow(),
    "lstm": CoreRow(),
    "transformer": CoreRow(attends=True),
}
ENCODERS = ("keypoints", "nature")
