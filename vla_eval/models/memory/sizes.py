"""Sizes of the positive control's network, and the numbers of a place in an image. Without torch."""

from dataclasses import dataclass

from vla_eval.models.episodes.config import SPACE

RGB, PLACE = 3, 2  # numbers of a colour, of a place in an image
APART = 1  # one number: how much a place stands out
KNOWN = APART + RGB + PLACE  # known of a place in addition to its learned features, in this order
SPOTS = 4  # spots along a place's edge
HALVES = 2  # along its edge: of each quarter of a place one spot is described
QUARTERS = HALVES**2


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSizes:
    """Sizes of the network."""

    on_arm: tuple[bool, ...] = (False, True)  # of each image of a step, whether its camera is on the arm
    image_px: int = 128  # height and width of an image, a multiple of `patch_px`
    action: int = 7
    chunk: int = 8
    channels: int = 32  # learned features of a place in an image
    patch_px: int = 4  # edge of such a place, a multiple of `SPOTS`
    heads: int = 8  # questions per camera: so many fixed ones, and so many of the memory
    key: int = 16  # numbers of a question
    memory: int = 256
    hidden: int = 256
    # the slowest units of the memory begin with a time scale of so many steps
    longest_span_steps: float = 100.0
    free_translation: bool = False  # whether a part of the translation does not depend on the goal
    joint_targets: bool = False
    reads_sentence: bool = False

    @property
    def decided_action(self) -> int:
        """Numbers of an action as it is decided: in space, whatever the joints have to do for it."""
        return SPACE + 1 if self.joint_targets else self.action

    @property
    def cameras(self) -> int:
        """Images of a step."""
        return len(self.on_arm)

    @property
    def value(self) -> int:
        """Numbers that attention returns of a place: features, standing out, colour, coordinates."""
        return self.channels + KNOWN

    @property
    def seen(self) -> int:
        """Numbers that one look at all images returns."""
        return self.cameras * self.heads * self.value
