"""Tasks without cue and delay: the information to remember is visible at the start, and then changes."""

from typing import Any

from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.memory_env import MemoryTableEnv
from vla_eval.tasks.objects.bodies import Flags, Steps


class WithoutCueEnv(MemoryTableEnv):
    """A memory task whose whole episode is the response phase; nothing is hidden or revealed.

    Arguments: those of `MemoryTableEnv` without `cue_steps` and `delay_steps`.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        for name in ("cue_steps", "delay_steps"):
            if name in kwargs:
                raise TaskArgumentError(
                    f"{name}: this task has no phases, its objects are always visible. Remove this argument."
                )
        super().__init__(*args, cue_steps=0, delay_steps=0, **kwargs)

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        return False
