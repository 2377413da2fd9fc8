"""The operator at a terminal: keys, without Enter after each. The dead man's key is one that repeats.

A terminal does not tell when a key is let go. Held down, it repeats some thirty times a second after a first
pause of up to a second: so the arm may move until `dead_man_seconds` after the last character of any key.
"""

import os
import select
import termios
import tty
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

from vla_eval.config.real_robot import RobotSettings
from vla_eval.envs.robot.operators import ABORT, HOLD, KEYS, MEANINGS, NEXT
from vla_eval.envs.robot.watch import Clock
from vla_eval.errors import OperatorError
from vla_eval.tasks.real_stages import Trial

POLL_SECONDS = 0.05
MOST_BYTES = 1024


class KeysOperator:
    """A person at the terminal `descriptor`; a context manager that gives the terminal back as it was."""

    def __init__(
        self,
        settings: RobotSettings,
        clock: Clock,
        *,
        descriptor: int,
        say: Callable[[str], None],
        stops: Callable[[], bool] = lambda: False,
    ) -> None:
        """Begin with the dead man's key not held; `say` shows a line, `stops`: whether Ctrl-C was pressed."""
        self._settings, self._clock = settings, clock
        self._descriptor = descriptor
        self._say = say
        self._stops = stops
        self._alive: float | None = None  # time of the last character
        self._pressed: list[str] = []
        self._before: list[Any] | None = None  # Any: termios' attributes

    def __enter__(self) -> Self:
        if not os.isatty(self._descriptor):
            raise OperatorError(
                "--operator keys: expected a terminal, found a file or a pipe. Run the command at a "
                "terminal, or rehearse with --robot simulated_so100 --operator scripted."
            )
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        for key in KEYS:
            name = {" ": "space", "\n": "Enter"}.get(key.character, key.character)
            self._say(f"  {name:6} {key.words}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def prepare(self, trial: Trial) -> None:
        """Say what to place, and wait for Enter."""
        self.ask(f"Episode {trial.number}, {trial.stage.name}: {trial.words(trial.stage.phases[0])}")

    def ask(self, words: str) -> None:
        """Show the words, and wait for Enter; x refuses."""
        self._read(0.0)  # what was typed before the question is no answer to it
        self._pressed = []
        self._say(f"{words} Enter: done; x: stop.")
        self._wait(lambda: NEXT in self._pressed, words)
        self._pressed = []

    def tell(self, words: str) -> None:
        """Show the words."""
        self._say(words)

    def pressed(self) -> Sequence[str]:
        """Return what was pressed since the last call."""
        self._read(0.0)
        pressed, self._pressed = self._pressed, []
        return pressed

    def until_held(self) -> None:
        """Wait for the space bar."""
        self._read(0.0)
        self._alive = None
        self._say("Hold the space bar: the arm moves.")
        self._wait(self.lets_move, "Hold the space bar.")

    def lets_move(self) -> bool:
        """Whether a key was pressed, or has repeated, a moment ago."""
        self._read(0.0)
        return self._alive is not None and (
            self._clock.now() - self._alive <= self._settings.dead_man_seconds
        )

    def _wait(self, is_done: Callable[[], bool], words: str) -> None:
        until = self._clock.now() + self._settings.operator_seconds
        while True:
            if self._stops():
                raise KeyboardInterrupt
            done = is_done()  # which may read
            if ABORT in self._pressed:
                self._pressed = []
                raise OperatorError(f"the operator said no to: {words}")
            if done:
                return
            if self._clock.now() >= until:
                raise OperatorError(
                    f"no answer for {self._settings.operator_seconds:g} s (operator_seconds) to: {words}"
                )
            self._read(POLL_SECONDS)

    def _read(self, seconds: float) -> None:
        """Take what has been typed, waiting for up to so long."""
        ready, _, _ = select.select([self._descriptor], [], [], seconds)
        if not ready:
            return
        typed = os.read(self._descriptor, MOST_BYTES)
        if not typed:
            raise OperatorError("the terminal is gone.")
        self._alive = self._clock.now()
        means = [MEANINGS.get(character.lower()) for character in typed.decode("utf-8", errors="replace")]
        if ABORT in means:
            self._alive = None
        self._pressed += [one for one in means if one is not None and one != HOLD]
