"""How many frames of the cue a policy got, from the phases and its inferences. Knows no simulator."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from vla_eval.results.grouping import RowEpisodes
from vla_eval.tasks.catalog import find_task
from vla_eval.tasks.spec import total_cue_steps

DEFAULT_CUE_STEPS = 5  # `cue_steps` of `MemoryTableEnv` and of the fake simulator; a test compares


class CueFrames(NamedTuple):
    """Frames of the cue that the policy got, minimum and maximum over the episodes."""

    fewest: int
    most: int

    def __str__(self) -> str:
        """Return `2`, or `2-3` if the cue's length is drawn per episode."""
        return str(self.most) if self.fewest == self.most else f"{self.fewest}-{self.most}"


def cue_frames(group: RowEpisodes, env: Mapping[str, Any]) -> CueFrames | None:  # Any: the task's arguments
    """Return how many frames of the cue a row's policy got per episode, with these arguments of the task.

    The observation at step s shows the cue if s < cue_steps, counted from `cue_after_steps` on. A policy that
    reads the last frame gets those of the steps 0, K, 2K, … that are among these; one that reads every frame
    gets all of them before it predicts. None for a task without a cue phase, or if nothing was rendered.
    """
    spec = find_task(group.key.task)
    if spec is None or spec.candidates is None or not group.results:
        return None
    arguments = {**spec.kwargs, **env}
    steps = arguments.get("cue_steps", DEFAULT_CUE_STEPS)
    n_in_turn = arguments.get("n_shown", 1) if spec.shows_one_by_one else 1
    gap_steps = arguments.get("gap_steps", 0)
    lengths = [steps] if isinstance(steps, int) else steps
    fewest, most = (total_cue_steps(f(lengths), n_in_turn, gap_steps) for f in (min, max))
    if any((r.n_frames or 0) > (r.n_inferences or 0) for r in group.results):  # it reads every frame
        return CueFrames(fewest, most)
    k = group.key.n_action_steps
    after = arguments.get("cue_after_steps", 0)
    # Inferences before a step: rounded up, as there is one at step 0.
    earlier, by_fewest, by_most = (-(-step // k) for step in (after, after + fewest, after + most))
    return CueFrames(by_fewest - earlier, by_most - earlier)
