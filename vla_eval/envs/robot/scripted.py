"""The scripted operator beside the simulated arm: it reads the true state, and presses the keys."""

from collections.abc import Sequence
from itertools import accumulate

from vla_eval.envs.robot.operators import NEXT, PICKED
from vla_eval.envs.robot.simulated import SimulatedSO100
from vla_eval.tasks.real_stages import COLORS, Trial


class ScriptedOperator:
    """Sets the table, begins each phase when the twin does, and marks what has happened."""

    def __init__(self, robot: SimulatedSO100) -> None:
        """Stand beside an arm."""
        self._robot = robot
        self._phase_steps: tuple[int, ...] = ()
        self._marked: set[str] = set()

    def prepare(self, trial: Trial) -> None:
        """Set the table."""
        self._robot.place(trial)
        self._phase_steps = tuple(accumulate(phase.twin_steps for phase in trial.stage.phases[:-1]))
        self._marked = set()

    def ask(self, words: str) -> None:
        """Confirm: the operator is back."""
        self._robot.end_fault("key", "away")

    def tell(self, words: str) -> None:
        """Hear."""

    def pressed(self) -> Sequence[str]:
        """Return the next phase when its time has come, and what has been touched or picked since."""
        if self._robot.has_fault("away"):
            return ()
        begins = NEXT if self._robot.n_steps in self._phase_steps else None
        status = self._robot.status
        seen = [COLORS[index] for index in status.touched_candidates or ()]
        seen += [PICKED] if status.success else []
        new = [key for key in seen if key not in self._marked]
        self._marked.update(new)
        return [*([begins] if begins else []), *new]

    def until_held(self) -> None:
        """Hold it."""

    def lets_move(self) -> bool:
        """Hold the key, unless the fault says otherwise."""
        return not self._robot.has_fault("key", "away")
