"""Remember episodes as they run: a `StepObserver` that others make videos and rerun recordings of.

What is worth keeping is often known only at the end (`failures`), so all of an episode is held in memory
until then: 0.9 MB per pictured step with the three cameras of the tasks. Running the episode a second
time instead would cost a second inference of everything, and on a GPU it need not be the same episode.
"""

from collections.abc import Collection
from dataclasses import dataclass, field

from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, StepResult


@dataclass(frozen=True, slots=True, kw_only=True)
class TapedStep:
    """What came back from one control step; the action asked for is None for the reset."""

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
    """One episode so far.

    Attributes:
        start: what the policy was told.
        frame_stride: pictures were asked for at every so many steps; others may have asked for more.
        steps, chunks: in order.
    """

    start: EpisodeStart
    frame_stride: int
    steps: list[TapedStep] = field(default_factory=list)
    chunks: list[TapedChunk] = field(default_factory=list)

    def pictured(self) -> list[TapedStep]:
        """Return the steps at even distances that have pictures, and the last one."""
        return [
            one
            for one in self.steps
            if one.result.observation.images and (one.step % self.frame_stride == 0 or one is self.steps[-1])
        ]


class Tapes:
    """Implements `StepObserver`.

    Args:
        slots: the slots whose episodes are kept.
        frame_stride: pictures are asked for at every so many control steps, and at the last one.
    """

    def __init__(self, slots: Collection[int], *, frame_stride: int) -> None:
        """Start with nothing taped."""
        self._slots = slots
        self._frame_stride = frame_stride
        self._horizons: set[int] = set()
        self.episodes: dict[int, EpisodeTape] = {}

    def wants_images(self, step: int) -> bool:
        """Whether a picture is due."""
        return step % self._frame_stride == 0 or step in self._horizons

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
