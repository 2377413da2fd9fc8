"""Progress of a recording on standard error: a bar on a terminal, now and then a line in a log file."""

import sys
import time
from typing import TYPE_CHECKING, Any, Literal

from tqdm import tqdm

from vla_eval.cli.progress import LINE_EVERY_SECONDS, StopRequest

if TYPE_CHECKING:
    from vla_eval.data.recording import Phase


class RecordingProgress:
    """Implements `RecordingObserver` and `ReplayObserver`; all but mismatches goes to standard error."""

    def __init__(self, stop: StopRequest) -> None:
        """Take the request to stop."""
        self._stop = stop
        self._bar: tqdm[Any] | None = None
        self._title = ""
        self._n_done = self._n_before = self._n_total = 0
        self._begun = self._last_line = time.monotonic()

    def on_phase(
        self, task: str, phase: "Phase | Literal['replaying']", *, n_done: int, n_total: int
    ) -> None:
        """Begin a new bar, or a new line."""
        self.close()
        self._title = f"{task}: {phase}"
        self._n_done = self._n_before = n_done
        self._n_total = n_total
        self._begun = self._last_line = time.monotonic()
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=n_total,
                initial=n_done,
                desc=self._title,
                unit="ep",
                file=sys.stderr,
                dynamic_ncols=True,
            )

    def on_progress(self, *, n_done: int) -> None:
        """Count."""
        if self._bar is not None:
            self._bar.update(n_done - self._n_done)
        self._n_done = n_done

    def on_mismatch(self, sentence: str) -> None:
        """Print it: it is what the command is for."""
        tqdm.write(sentence, file=sys.stdout)

    def on_tick(self) -> bool:
        """Write a line now and then; return whether a signal has asked to stop."""
        if self._bar is None and time.monotonic() - self._last_line >= LINE_EVERY_SECONDS:
            self._line()
        return self._stop.signal_number is not None

    def close(self) -> None:
        """Write how far the phase has come."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        elif self._n_done > self._n_before:
            self._line()
        self._n_before = self._n_done

    def _line(self) -> None:
        self._last_line = time.monotonic()
        minutes = (self._last_line - self._begun) / 60
        per_minute = (self._n_done - self._n_before) / max(minutes, 1e-9)
        left = (self._n_total - self._n_done) / per_minute if per_minute > 0 else None
        remaining = "" if not left else f", {left:.1f} min left"
        tqdm.write(
            f"{self._title}: {self._n_done}/{self._n_total} episodes after {minutes:.1f} min, "
            f"{per_minute:.1f} per minute{remaining}",
            file=sys.stderr,
        )
        sys.stderr.flush()
