"""What a policy is given to see of the cue: the world is the same, its observations' images differ."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import Observation, ObservationWindow, SimEnv, StepResult
from vla_eval.errors import SpecMismatchError, TaskArgumentError
from vla_eval.specs import PolicySpec
from vla_eval.task_state import Phase

CueViewKind = Literal["as_shown", "first_frame", "hidden", "hidden_elsewhere", "hidden_later"]
"""As rendered; its first frame throughout; its place grey; as many other pixels grey; its place grey, but
in the delay."""

GREY = 127  # of each channel, where an image is hidden
SHIFT_PX = 8  # step of the search for other pixels

PixelMask = NDArray[np.bool_]
"""(H, W): the pixels to hide."""


class PixelBox(NamedTuple):
    """Rows top to bottom - 1 and columns left to right - 1 of an image."""

    top: int
    bottom: int
    left: int
    right: int


CueBoxes = Mapping[str, tuple[PixelBox, ...]]
"""Camera -> boxes, within its image, that hold all of the cue; none where the cue is out of its view."""


@runtime_checkable
class CueLocator(Protocol):
    """An environment that knows where in its images the cue is, or would be if it were shown."""

    def cue_boxes(self, slot: int) -> CueBoxes:
        """Return the boxes in the images of the present step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CueViewSettings:
    """What a policy sees of the cue."""

    kind: CueViewKind = "as_shown"  # see `CueViewKind`
    begins_at: int = 0  # the step of the cue's first frame; earlier frames are never changed

    @property
    def hides(self) -> bool:
        """Whether part of an image is hidden, so that the cue has to be located."""
        return self.kind.startswith("hidden")


AS_SHOWN = CueViewSettings()


def cue_locator(env: SimEnv, settings: CueViewSettings, cameras: Sequence[str]) -> Callable[[int], CueBoxes]:
    """Return where the cue of a slot is in the images that a policy reads."""
    if not settings.hides or not cameras:
        return lambda _slot: {}
    if isinstance(env, CueLocator):
        return env.cue_boxes
    raise no_cue_locator(settings.kind, env.spec.task)


def no_cue_locator(kind: CueViewKind, task: str) -> SpecMismatchError:
    """Return the error for an environment in which the cue cannot be hidden."""
    return SpecMismatchError(
        f"cue_view={kind}: {task}: this environment cannot tell where in its images the cue is. Use another "
        "one, or leave this view out."
    )


@dataclass(slots=True, kw_only=True)
class CueView:
    """What one episode's policy is given: results are noted in order, each step once."""

    settings: CueViewSettings
    locate: Callable[[], CueBoxes]
    _frames: list[Observation] = field(default_factory=list)  # since the last inference
    _first: Observation | None = None
    _boxes: list[CueBoxes] = field(default_factory=list)
    _n_delay_steps: int = 0

    def needs_images(self, step: int) -> bool:
        """Return whether the images of a step are shown again at later ones."""
        return self.settings.kind == "first_frame" and step == self.settings.begins_at

    def note(self, result: StepResult) -> None:
        """Keep what the policy is given of this result until its next inference; raises as `seen`."""
        self._frames.append(self.seen(result.observation, result.status.phase))

    def forget_before(self, step: int) -> None:
        """Drop the observations of earlier steps that the policy was not given yet."""
        self._frames = [frame for frame in self._frames if frame.step >= step]

    def take(self, slot: int, spec: PolicySpec) -> ObservationWindow:
        """Return the observations since the last inference, or only the newest one; none is given twice."""
        frames, self._frames = self._frames, []
        read = frames if spec.reads == "every" else frames[-1:]
        return ObservationWindow(slot=slot, frames=tuple(frame.as_declared(spec) for frame in read))

    def seen(self, observation: Observation, phase: Phase | None) -> Observation:
        """Return what the policy is given in place of an observation; each step once."""
        kind = self.settings.kind
        in_cue = phase == "cue" and observation.step >= self.settings.begins_at
        if kind == "as_shown" or not (in_cue or phase == "delay"):
            return observation
        if kind == "first_frame":
            return self._with_first(observation) if in_cue else observation
        if in_cue:
            self._boxes.append(self.locate())
            return observation if kind == "hidden_later" else _hidden(observation, self._boxes[-1], kind)
        if kind != "hidden_later" or not self._boxes:
            return observation
        index, self._n_delay_steps = self._n_delay_steps, self._n_delay_steps + 1
        return _hidden(observation, self._boxes[index], kind) if index < len(self._boxes) else observation

    def _with_first(self, observation: Observation) -> Observation:
        if self._first is None:
            self._first = observation
        first = self._first.images  # of all cameras that the policy reads: `needs_images`
        images = {name: first.get(name, image).copy() for name, image in observation.images.items()}
        return replace(observation, images=images)


def _hidden(observation: Observation, boxes: CueBoxes, kind: CueViewKind) -> Observation:
    images = {}
    for name, image in observation.images.items():
        mask = np.zeros(image.shape[:2], dtype=np.bool_)
        for box in boxes.get(name, ()):
            mask[box.top : box.bottom, box.left : box.right] = True
        if kind == "hidden_elsewhere":
            mask = _elsewhere(mask, where=f"{name}, step {observation.step}")
        images[name] = image.copy()
        images[name][mask] = GREY
    return replace(observation, images=images)


def _elsewhere(mask: PixelMask, *, where: str) -> PixelMask:
    """Return as many other pixels, in the same form: shifted, as far away as that can be."""
    height, width = mask.shape
    shifts = [(y, x) for y in range(0, height, SHIFT_PX) for x in range(0, width, SHIFT_PX)]
    # In an image whose edges are joined, so that the number of pixels stays the same.
    shifts.sort(key=lambda s: -min(s[0], height - s[0]) - min(s[1], width - s[1]))
    for shift in shifts:
        moved = np.roll(mask, shift, axis=(0, 1))
        if not (moved & mask).any():
            return moved
    raise TaskArgumentError(
        f"cue_view=hidden_elsewhere: {where}: the cue takes {mask.mean():.0%} of the image, and as much of "
        "this form is not there beside it. Leave this view out for this task."
    )
