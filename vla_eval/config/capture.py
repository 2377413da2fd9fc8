"""Which episodes are captured, and how often frames are rendered for it. Knows no files and no viewers."""

from dataclasses import dataclass
from typing import Literal

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import MAX_EPISODES, Steps, check_bounds

Outcomes = Literal["none", "all", "failures", "successes"]
Which = Outcomes | int


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureConfig:
    """What to capture of an evaluation; moves no result."""

    # which episodes get an mp4: by outcome, or the first N seeds of run 0 of each task, policy and
    # n_action_steps
    video: Which = "none"
    rrd: Which = "none"  # which episodes get a file for the rerun viewer, likewise
    frame_stride: Steps = 2  # control steps from one frame to the next

    def __post_init__(self) -> None:
        check_bounds(self, prefix="capture.")
        for name in ("video", "rrd"):
            which = getattr(self, name)
            if isinstance(which, int) and not 1 <= which <= MAX_EPISODES:
                raise RecipeError(
                    f"capture.{name} is {which}, expected 'none', 'all', 'failures', 'successes' or a "
                    f"number of episodes from 1 to {MAX_EPISODES}."
                )

    @property
    def is_on(self) -> bool:
        """Whether anything is captured."""
        return self.video != "none" or self.rrd != "none"

    def films_afterwards(self, sim_backend: str) -> bool:
        """Whether episodes run without images, and those wanted once more: the outcome alone decides."""
        return sim_backend == "cpu" and {self.video, self.rrd} <= {"none", "failures", "successes"}


def may_be_wanted(which: Which, *, run: int, index: int) -> bool:
    """Return whether the episode of a run with its seed of this index, from 0, may have to be captured."""
    return run == 0 and index < which if isinstance(which, int) else which != "none"


def is_wanted(which: Which, *, run: int, index: int, is_success: bool) -> bool:
    """Return whether the capture of a finished episode is kept."""
    if which in ("failures", "successes"):
        return is_success == (which == "successes")
    return may_be_wanted(which, run=run, index=index)
