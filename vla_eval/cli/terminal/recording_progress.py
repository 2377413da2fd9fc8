"""Progress of a recording or a replay on standard error: a bar or a line per phase."""

import sys
from typing import TYPE_CHECKING

from tqdm import tqdm

from vla_eval.cli.terminal.episode_bar import EpisodeBar
from vla_eval.cli.terminal.json_progress import JsonLines, PhaseLines
from vla_eval.cli.terminal.progress import StopRequest

if TYPE_CHECKING:
    from vla_eval.data.recording.record import Phase


class RecordingProgress:
    """A `RecordingObserver`; all but mismatches goes to standard error."""

    def __init__(self, stop: StopRequest, *, json_progress: int | None = None) -> None:
        """Take the request to stop, and where lines for other programs go."""
        lines = JsonLines(json_progress)
        self._stop = stop
        self._bar = EpisodeBar(is_quiet=lines.is_stderr)
        self._lines = PhaseLines(lines)

    def say(self, sentence: str) -> None:
        """Write a sentence to standard error."""
        self._bar.write(sentence)

    def on_phase(self, task: str, phase: "Phase", *, n_done: int, n_total: int) -> None:
        """Begin a new bar, or a new line."""
        self._lines.on_phase(task, phase, n_done=n_done, n_total=n_total)
        self._bar.begin(n_done=n_done, n_total=n_total, title=f"{task}: {phase}")

    def on_progress(self, *, n_done: int) -> None:
        """Count."""
        self._lines.on_progress(n_done=n_done)
        self._bar.advance(n_done=n_done)

    def on_mismatch(self, sentence: str) -> None:
        """Print it: it is what the command is for."""
        self._lines.on_mismatch(sentence)
        tqdm.write(sentence, file=sys.stdout)

    def on_tick(self) -> bool:
        """Write a line now and then; return whether a signal has asked to stop."""
        self._bar.tick()
        self._lines.on_tick()
        return self._stop.is_asked

    def close(self) -> None:
        """Write how far the phase has come."""
        self._bar.close()
        self._lines.close(stopped=self._stop.is_asked)
