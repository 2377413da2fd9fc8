"""An image from each camera at the moment of each mark: evidence of what the operator saw. A `StepObserver`.

Names say the number in the plan, step and mark, and not the policy: the operator may look.
"""

from pathlib import Path

from PIL import Image

from vla_eval.core import EpisodeStart, FloatArray, StepObserver, StepResult
from vla_eval.storage.folders import MARKS
from vla_eval.tasks.real_stages import COLORS


class MarkImages(StepObserver):
    """Writes the images into a run folder."""

    def __init__(self, folder: Path, number: int) -> None:
        """Write nothing yet; `number`: of the episode in the plan."""
        self._folder = folder / MARKS
        self._number = number
        self._known: set[str] = set()

    def wants_images(self, step: int) -> bool:
        """Whether a mark may come: at every step."""
        return True

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Begin without marks."""
        self._known = set()

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Write images of what is new."""
        status = result.status
        marks = [f"touched-{COLORS[index]}" for index in status.touched_candidates or ()]
        marks += ["picked"] if status.success else []
        for mark in marks:
            if mark in self._known:
                continue
            self._known.add(mark)
            self._folder.mkdir(exist_ok=True)
            for camera, image in result.observation.images.items():
                name = f"episode{self._number:04d}_step{result.observation.step:05d}_{mark}_{camera}.png"
                Image.fromarray(image).save(self._folder / name)
