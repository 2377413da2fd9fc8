"""Progress of a run on standard error: a bar on a terminal, now and then a line in a log file."""

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from tqdm import tqdm

from vla_eval.evaluate import EvaluationSummary, evaluate
from vla_eval.plan import Plan
from vla_eval.recipes import EvalConfig
from vla_eval.results.records import EpisodeRecord

LINE_EVERY_SECONDS = 60.0
STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


@dataclass(slots=True)
class StopRequest:
    """The signal that asked the run to stop, if any."""

    signal_number: int | None = None

    @property
    def exit_code(self) -> int:
        """What shells expect of a command that a signal has ended."""
        return 128 + (self.signal_number or 0)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn Ctrl-C, SIGTERM and SIGHUP into a request, so that no record is cut in the middle.

    A second signal does not wait: it raises KeyboardInterrupt.
    """
    request = StopRequest()

    def ask(number: int, _frame: FrameType | None) -> None:
        if request.signal_number is not None:
            raise KeyboardInterrupt
        request.signal_number = number

    previous: dict[int, Any] = {}  # Any: what `signal.signal` takes and gives
    for name in STOP_SIGNALS:
        number = getattr(signal, name)
        # `nohup` has SIGHUP ignored: leave it so.
        if signal.getsignal(number) is not signal.SIG_IGN:
            previous[number] = signal.signal(number, ask)
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def evaluate_with_progress(
    config: EvalConfig, *, out: Path, command: str, stop: StopRequest, allow_environment_change: bool = False
) -> EvaluationSummary:
    """Run an evaluation, say on standard error how far it has come, and end early if asked to stop.

    Raises:
        VlaEvalError: see `evaluate`.
    """
    progress = Progress(stop, out=str(out))
    try:
        return evaluate(
            config,
            out=out,
            command=command,
            allow_environment_change=allow_environment_change,
            observer=progress,
        )
    finally:
        progress.close()


class Progress:
    """Implements `EvaluationObserver` on standard error."""

    def __init__(self, stop: StopRequest, *, out: str) -> None:
        """Take the request to stop, and the name of the run folder for messages."""
        self._stop = stop
        self._out = out
        self._bar: tqdm[Any] | None = None
        self._n_episodes = self._n_done = self._n_errors = self._n_results = self._n_successes = 0
        self._begun = self._last_line = time.monotonic()

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        """Say how much there is to do, and what is left out."""
        n_episodes = len(plan.jobs)
        self._n_episodes, self._n_done = n_episodes, n_finished
        for pair in plan.left_out:
            self._write(f"left out: {pair}")
        if n_finished == n_episodes:
            self._write(f"{self._out}: all {n_episodes} episodes are there")
            return
        workers = "1 worker" if n_workers == 1 else f"{n_workers} workers"
        self._write(f"{self._out}: {n_episodes} episodes, {n_finished} of them finished before, {workers}")
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=n_episodes, initial=n_finished, unit="ep", file=sys.stderr, dynamic_ncols=True
            )

    def on_record(self, record: EpisodeRecord) -> None:
        """Count the record; say at once what went wrong."""
        self._n_done += 1
        if record.error is not None:
            self._n_errors += 1
            where = f"{record.policy} on {record.task}, seed {record.seed}, run {record.run}"
            self._write(f"error: {where}: {record.error.kind}: {record.error.message}")
        else:
            self._n_results += 1
            self._n_successes += bool(record.success_once)
        if self._bar is not None:
            self._bar.update()
            self._bar.set_postfix_str(self._counts())

    def on_tick(self) -> bool:
        """Write a line now and then; return whether a signal has asked to stop."""
        if self._bar is None and time.monotonic() - self._last_line >= LINE_EVERY_SECONDS:
            self._line()
        return self._stop.signal_number is not None

    def close(self) -> None:
        """Write how far it has come."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        elif self._n_results or self._n_errors:
            self._line()

    def _line(self) -> None:
        self._last_line = time.monotonic()
        minutes = (self._last_line - self._begun) / 60
        self._write(f"{self._n_done}/{self._n_episodes} episodes after {minutes:.1f} min, {self._counts()}")

    def _counts(self) -> str:
        rate = f"success {self._n_successes / self._n_results:.2f}" if self._n_results else "no result yet"
        return f"{rate}, errors {self._n_errors}"

    def _write(self, text: str) -> None:
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()
