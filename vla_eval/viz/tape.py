"""Record episodes in memory as they run: a `StepObserver`, from which videos and rerun files are made.

A whole episode is held in memory until it ends: 0.9 MB per captured step with the three cameras of the tasks.
Without images, an episode whose outcome decides whether it is filmed takes a few kB; `filming` runs it again.
"""

from collections.abc import Collection
from dataclasses import dataclass, field

from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, StepResult


@dataclass(frozen=True, slots=True, kw_only=True)
class TapedStep:
    """The result of one control step; the requested action is None for the reset."""

    step: int
    action: FloatArray | None
    result: StepResult


@dataclass(frozen=True, slots=True, kw_only=True)
class TapedChunk:
    """A chunk, and the step whose observation it answers."""

    step: int
    chunk: ActionChunk


@dataclass(slots=True, kw_only=True)
class EpisodeTape:
    """One episode so far: steps and chunks in order, with images at least at every `frame_stride`-th step."""

    start: EpisodeStart
    frame_stride: int
    steps: list[TapedStep] = field(default_factory=list)
    chunks: list[TapedChunk] = field(default_factory=list)

    def captured(self) -> list[TapedStep]:
        """Return the steps at the stride that have images, and the last one."""
        return [
            one
            for one in self.steps
            if one.result.observation.images and (one.step % self.frame_stride == 0 or one is self.steps[-1])
        ]


class Tapes:
    """A `StepObserver` that keeps the episodes of some slots, with images at a stride and at the end."""

    def __init__(self, slots: Collection[int], *, frame_stride: int, with_images: bool = True) -> None:
        self._slots = slots
        self._frame_stride = frame_stride
        self._with_images = with_images
        self._horizons: set[int] = set()
        self.episodes: dict[int, EpisodeTape] = {}

    def wants_images(self, step: int) -> bool:
        """Whether an image is due."""
        is_due = step % self._frame_stride == 0 or step in self._horizons
        return self._with_images and is_due

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Begin an episode."""
        if episode.slot in self._slots:
            self._horizons.add(episode.horizon_steps)
            tape = EpisodeTape(start=episode, frame_stride=self._frame_stride)
            tape.steps.append(TapedStep(step=0, action=None, result=result))
            self.episodes[episode.slot] = tape

    def on_inference(self, episode: EpisodeStart, step: int, chunk: ActionChunk) -> None:
        """Keep the chunk."""
        if episode.slot in self._slots:
            kept = ActionChunk(actions=chunk.actions.copy())  # a policy may reuse its buffer
            self.episodes[episode.slot].chunks.append(TapedChunk(step=step, chunk=kept))

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Keep the step."""
        if episode.slot in self._slots:
            tape = self.episodes[episode.slot]
            tape.steps.append(TapedStep(step=len(tape.steps), action=action.copy(), result=result))
