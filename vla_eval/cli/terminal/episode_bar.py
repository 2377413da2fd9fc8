"""Show how many episodes are done: tqdm's bar on a terminal, elsewhere a line from time to time."""

import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from tqdm import tqdm

from vla_eval.plain_text import printable

FIRST_LINE_SECONDS = 30.0
LINE_EVERY_SECONDS = 60.0


class EpisodeBar:
    """Shows on standard error how many episodes are done, and the time left; `is_quiet` writes nothing."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic, is_quiet: bool = False) -> None:
        self._clock = clock
        self._is_quiet = is_quiet
        self._bar: tqdm[Any] | None = None
        self._title = self._note = self._doing = self._load = ""
        self._n_done = self._n_before = self._n_total = self._n_steps = self._n_running_steps = 0
        self._begun = self._last_line = clock()

    def begin(self, *, n_done: int, n_total: int, title: str = "") -> None:
        """Start a new count, of which `n_done` episodes are done already."""
        self.close()
        self._title, self._note, self._doing, self._load = title, "", "", ""
        self._n_steps = self._n_running_steps = 0
        self._n_done = self._n_before = n_done
        self._n_total = n_total
        self._begun = self._last_line = self._clock()
        if (sys.stderr.isatty() or _is_notebook()) and not self._is_quiet:
            self._bar = _bar_class()(
                total=n_total,
                initial=n_done,
                desc=printable(title) or None,  # tqdm adds codes of its own to what has some
                unit="ep",
                file=sys.stderr,
                dynamic_ncols=True,
            )

    def doing(self, text: str) -> None:
        """Say what is being done before the first episode ends."""
        self._doing = text
        if self._bar is not None and self._n_done == self._n_before:
            self._bar.set_postfix_str(printable(text))

    def advance(self, *, n_done: int, n_steps: int = 0, note: str = "") -> None:
        """Count; `n_steps` control steps were executed for it, and `note` says how it goes."""
        self._n_steps += n_steps
        moved, self._n_done, self._note = n_done - self._n_done, n_done, note
        if self._bar is not None:
            self._bar.update(moved)
            if note:  # each postfix is a redraw, which a bar without one need not have
                self._redraw()

    def load(self, text: str, *, n_steps: int | None) -> None:
        """Show what the workers are doing, and the steps of episodes under way; None: not known."""
        self._load, self._n_running_steps = text, n_steps or 0
        if self._bar is not None and (self._n_done > self._n_before or n_steps):
            self._redraw()

    def tick(self) -> None:
        """Write a line if it is time and there is no bar."""
        wait = LINE_EVERY_SECONDS if self._last_line > self._begun else FIRST_LINE_SECONDS
        if self._bar is None and self._clock() - self._last_line >= wait:
            self._line()

    def close(self) -> None:
        """Write how far it has come, if it has."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        elif self._n_done > self._n_before:
            self._line()
        self._n_before = self._n_done

    def write(self, text: str) -> None:
        """Write a sentence above the bar."""
        if not self._is_quiet:
            tqdm.write(text, file=sys.stderr)
            sys.stderr.flush()

    def _redraw(self) -> None:
        assert self._bar is not None  # the callers look
        text = ", ".join(filter(None, (self._steps(), self._note, self._load)))
        self._bar.set_postfix_str(printable(text))

    def _steps(self) -> str:
        n_steps = self._n_steps + self._n_running_steps
        return f"{n_steps:,} control steps" if n_steps else ""

    def _line(self) -> None:
        self._last_line = self._clock()
        minutes = (self._last_line - self._begun) / 60
        per_minute = (self._n_done - self._n_before) / max(minutes, 1e-9)
        n_left = self._n_total - self._n_done
        steps = f" ({self._steps()})" if self._steps() else ""
        parts = [
            f"{self._n_done}/{self._n_total} episodes{steps} after {minutes:.1f} min",
            f"{per_minute:.1f} per minute",
        ]
        if n_left and per_minute > 0:
            parts.append(f"{n_left / per_minute:.1f} min left")
        elif n_left:
            doing = [self._doing] if self._doing else []
            parts = [parts[0], *doing, "none has ended yet, so the remaining time is unknown"]
        parts += filter(None, (self._note, self._load))
        self.write((f"{self._title}: " if self._title else "") + ", ".join(parts))


def _is_notebook() -> bool:
    """Whether standard error is a cell of Jupyter, which draws a bar over itself as a terminal does."""
    return type(sys.stderr).__module__.partition(".")[0] == "ipykernel"


def _bar_class() -> Any:  # tqdm is untyped
    """Return tqdm's bar for this place: a widget in Jupyter, where ipywidgets is installed."""
    if not _is_notebook() or find_spec("ipywidgets") is None:
        return tqdm
    from tqdm.notebook import tqdm as widget

    return widget
