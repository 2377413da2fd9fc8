"""Which earlier frames are shown beside the newest one: one rule for training and rollouts."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import ImageArray
from vla_eval.errors import RecipeError, check_names
from vla_eval.models.shared.images import MAX_LEVEL

BLOCKS = (8, 16, 32)  # per side of an image; of 128 px: 16, 8 and 4 px
NEAR, FAR = 2, 5  # blocks: what changes between these distances from a block is its surroundings
RULES = ("last", "keyframes")
"""`last`: every `stride`-th frame before the newest. `keyframes`: the last frame before each of the greatest
changes of the scene, so what was in view and is no longer."""
BURST_FRAMES = 4  # changes in so many frames are one event: cups come down, a cube is replaced

Values = NDArray[np.float64]
Blocks = tuple[Values, ...]
"""(3, n, n) for each n of `BLOCKS`: mean colours of an image's blocks, in [0, 1]."""


class Event(NamedTuple):
    """A change of the scene: the last frame before it, and the greatest `novelty` of its burst."""

    number: int
    novelty: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What a rule keeps of `n_frames` so far: blocks of the newest if it looks, and events, oldest first."""

    n_frames: int = 0
    blocks: Blocks | None = None
    events: tuple[Event, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameChoice:
    """A rule and its numbers."""

    rule: str  # a name of `RULES`
    n_places: int  # so many frames are shown at most
    stride: int  # of the rule `last`: control steps between them
    least_novelty: float  # of the rule `keyframes`: a smaller change is not an event; see `novelty`

    def __post_init__(self) -> None:
        check_names("rule", [self.rule], RULES, where="policy.memory_rule")
        for name, value in (("memory_places", self.n_places), ("memory_stride", self.stride)):
            if value < 1:
                raise RecipeError(f"policy.{name} is {value}, expected a number ≥ 1")
        if not 0 < self.least_novelty < 1:
            raise RecipeError(
                f"policy.memory_novelty is {self.least_novelty}, expected a number between 0 and 1"
            )

    @property
    def looks(self) -> bool:
        """Whether the rule looks at images."""
        return self.rule == "keyframes"

    def after(self, seen: Seen, image: ImageArray | None) -> Seen:
        """Return what is kept after one more frame (3, H, W) uint8; None: the rule does not look at it."""
        if not self.looks:
            return replace(seen, n_frames=seen.n_frames + 1)
        if image is None:
            raise ValueError("the rule 'keyframes' chooses from images, found none")
        blocks = blocks_of(image)
        changed = 0.0 if seen.blocks is None else novelty(seen.blocks, blocks)
        events = seen.events
        if changed >= self.least_novelty:
            events = _with_event(events, Event(seen.n_frames - 1, changed), self.n_places)
        return Seen(n_frames=seen.n_frames + 1, blocks=blocks, events=events)

    def shown(self, seen: Seen) -> tuple[int | None, ...]:
        """Return the frame shown at each place: the nearest first by `last`, the oldest by `keyframes`."""
        if self.looks:
            numbers = [event.number for event in seen.events]
        else:
            numbers = list(range(seen.n_frames - 1 - self.stride, -1, -self.stride))[: self.n_places]
        return (*numbers, *[None] * (self.n_places - len(numbers)))

    def wanted(self, seen: Seen) -> frozenset[int]:
        """Return the numbers of the frames that are shown, or may be after further frames."""
        if self.looks:
            return frozenset({*(event.number for event in seen.events), seen.n_frames - 1})
        oldest = seen.n_frames - 1 - self.n_places * self.stride
        return frozenset(range(max(0, oldest), seen.n_frames))


def blocks_of(image: ImageArray) -> Blocks:
    """Return the mean colours of the blocks of an image (3, H, W) of 32 pixels or more each way, exactly."""
    return tuple(_means(image.astype(np.int64), n) for n in BLOCKS)


def _means(image: NDArray[np.int64], n_blocks: int) -> Values:
    _, height, width = image.shape
    rows, columns = ((np.arange(n_blocks) * size) // n_blocks for size in (height, width))
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=1), columns, axis=2)
    n_pixels = np.outer(np.diff(rows, append=height), np.diff(columns, append=width))
    return sums / (n_pixels * MAX_LEVEL)


def novelty(before: Blocks, after: Blocks) -> float:
    """Return by how much the image changes in one place more than around it, 0 to 1 (docs/vla_memory.md)."""
    return max(_alone(np.abs(new - old).mean(axis=0)) for old, new in zip(before, after, strict=True))


def _alone(changes: Values) -> float:
    """Return the greatest of changes (n, n) less what changes around it."""
    offsets = np.abs(np.arange(-FAR, FAR + 1))
    around = np.maximum.outer(offsets, offsets) >= NEAR
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(changes, FAR), around.shape)
    return float((changes - windows[..., around].max(axis=-1)).max())


def _with_event(events: tuple[Event, ...], event: Event, n_places: int) -> tuple[Event, ...]:
    """Return the events with one more, or with a burst that grew; of too many, the least one goes."""
    if events and event.number - events[-1].number < BURST_FRAMES:
        begun = events[-1]
        return (*events[:-1], Event(begun.number, max(begun.novelty, event.novelty)))
    events = (*events, event)
    if len(events) <= n_places:
        return events
    least = min(event.novelty for event in events)
    gone = max(place for place, event in enumerate(events) if event.novelty == least)  # of equals, the newest
    return events[:gone] + events[gone + 1 :]
