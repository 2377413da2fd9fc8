"""Progress of a run on standard error: a bar on a terminal, a line from time to time in a log file."""

import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from vla_eval.cli.terminal.episode_bar import EpisodeBar
from vla_eval.cli.terminal.json_progress import EvaluationLines, JsonLines, PhaseLines
from vla_eval.config.evaluation import CaptureConfig
from vla_eval.evaluation.evaluate import EvaluationObserver, EvaluationSummary, evaluate
from vla_eval.evaluation.plan import Plan
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.records import EpisodeRecord
from vla_eval.workers.load import Load

if TYPE_CHECKING:  # of the recorder, which takes longer to import
    from vla_eval.data.recording.record import Phase
    from vla_eval.training.request import FinetuneSummary

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
STDERR = 2
ANSWER_TO_STOP = "Stopping after this step, with a checkpoint. Once more: at once, without one."
"""Of a training."""
MAX_RATES = 4  # policies whose success a line shows
MEGABYTES_PER_FRAME = 0.9  # 3 × (512² + 2 × 128²) bytes


@dataclass(slots=True)
class StopRequest:
    """The signal that asked the run to stop, if any."""

    signal_number: int | None = None

    @property
    def is_asked(self) -> bool:
        """Whether a signal has come."""
        return self.signal_number is not None

    @property
    def exit_code(self) -> int:
        """What shells expect of a command that a signal has ended; without one, that of SIGTERM."""
        return 128 + (self.signal_number or signal.SIGTERM)


@contextmanager
def stop_on_signals(answer: str = "") -> Iterator[StopRequest]:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP into a request; a second one raises KeyboardInterrupt."""
    request = StopRequest()

    def ask(number: int, _frame: FrameType | None) -> None:
        if request.is_asked:
            raise KeyboardInterrupt
        request.signal_number = number
        if answer:
            os.write(STDERR, f"\n{answer}\n".encode())  # `print` may be what was interrupted

    previous: dict[int, Any] = {}  # Any: what `signal.signal` takes and gives
    is_main = threading.current_thread() is threading.main_thread()  # only there may handlers be set
    for name in STOP_SIGNALS if is_main else ():
        number = getattr(signal, name)
        # `nohup` has SIGHUP ignored: leave it so.
        if signal.getsignal(number) is not signal.SIG_IGN:
            previous[number] = signal.signal(number, ask)
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def train_with_progress[C](
    train: "Callable[..., FinetuneSummary]", config: C, *, command: str, answer: str
) -> "tuple[FinetuneSummary, StopRequest | None]":
    """Train, or resume it, with lines on standard error; the request if a signal has stopped it."""
    # Libraries' policies print while they are made.
    with stop_on_signals(answer) as stop, redirect_stdout(sys.stderr):
        summary = train(
            config,
            command=command,
            say=lambda line: tqdm.write(line, file=sys.stderr),
            is_stopping=lambda: stop.is_asked,
        )
    return summary, None if summary.is_finished else stop


def evaluate_with_progress(
    resolved: ResolvedEvaluation,
    *,
    command: str,
    stop: StopRequest,
    allow_environment_change: bool,
    json_progress: int | None,
    is_enough: Callable[[EpisodeRecord | None], bool] = lambda _: False,
) -> EvaluationSummary:
    """Run an evaluation with progress on standard error.

    It ends early if asked to stop, or once `is_enough` says so: of a record that has come, or, before the
    first one, of those that were there (None).
    """
    capture = resolved.config.capture
    progress = Progress(
        stop, out=resolved.out, capture=capture, json_progress=json_progress, is_enough=is_enough
    )
    try:
        return evaluate(
            resolved, command=command, allow_environment_change=allow_environment_change, observer=progress
        )
    finally:
        progress.close()


def capture_cost(capture: CaptureConfig, *, sim_backend: str) -> str:
    """Return what capturing takes, before it begins."""
    if capture.films_afterwards(sim_backend):
        return (
            "capturing: episodes are filmed after they have run, with the same actions, if their outcome is "
            f"the one that is wanted: every {capture.frame_stride} control steps an image of 512 × 512 and "
            "two of 128 × 128."
        )
    return (
        f"capturing: every {capture.frame_stride} control steps an image of 512 × 512 and two of 128 × 128, "
        f"also for policies that read none; {MEGABYTES_PER_FRAME} MB of memory each until the episode is "
        "over. On a CPU this is most of an episode's time: a larger capture.frame_stride costs less."
    )


def success_text(successes: Mapping[str, Sequence[bool]]) -> str:
    """Return the success of each policy so far; of more than a line has room for, nothing."""
    if not successes:
        return "no result yet, "
    if len(successes) > MAX_RATES:
        return ""
    rates = [f"{policy} {sum(ended) / len(ended):.2f}" for policy, ended in successes.items()]
    return f"success {', '.join(rates)}; "


def load_text(load: Load, *, n_open: int) -> str:
    """Return what a cluster's machines do, and how many episodes wait; nothing for this machine alone."""
    if not load.machines:
        return ""
    used = [machine for machine in load.machines if machine.is_used]
    machines = "1 machine" if len(used) == 1 else f"{len(used)} machines"
    shares = [machine.gpu_share for machine in used if machine.gpu_share is not None]
    gpu = f", GPUs {sum(shares) / len(shares):.0%} busy" if shares else ""
    return f"{machines}{gpu}, {max(0, n_open - load.n_running)} episodes in the queue"


class _BarAndLines[L: EvaluationLines | PhaseLines]:
    """A bar for people and lines for other programs, side by side."""

    def __init__(self, stop: StopRequest, lines: L, *, is_quiet: bool) -> None:
        self._stop = stop
        self._lines = lines
        self._bar = EpisodeBar(is_quiet=is_quiet)

    def on_tick(self) -> bool:
        """Write a line now and then; return whether a signal has asked to stop."""
        self._bar.tick()
        self._lines.on_tick()
        return self._stop.is_asked

    def close(self) -> None:
        self._bar.close()
        self._lines.close(stopped=self._stop.is_asked)


class Progress(_BarAndLines[EvaluationLines], EvaluationObserver):
    """Shows an evaluation on standard error."""

    def __init__(
        self,
        stop: StopRequest,
        *,
        out: Path,
        capture: CaptureConfig,
        json_progress: int | None = None,
        is_enough: Callable[[EpisodeRecord | None], bool] = lambda _: False,
    ) -> None:
        lines = JsonLines(json_progress)
        super().__init__(stop, EvaluationLines(lines, out=out), is_quiet=lines.is_stderr)
        self._is_enough = is_enough
        self._has_enough = False
        self._capture = capture
        self._out = out
        self._n_total = self._n_done = self._n_errors = 0
        self._successes: dict[str, list[bool]] = {}  # policy -> of each episode that ran now

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        """Say how much there is to do, and what is left out."""
        self._has_enough = self._is_enough(None)
        self._lines.on_start(plan, n_finished=n_finished, n_workers=n_workers)
        n_episodes = len(plan.jobs)
        for pair in plan.left_out:
            self._bar.write(f"left out: {pair}")
        for warning in plan.warnings:
            self._bar.write(f"warning: {warning}")
        for note in plan.notes:
            self._bar.write(f"note: {note}")
        if n_finished == n_episodes:
            self._bar.write(f"{self._out}: all {n_episodes} episodes are there")
            return
        workers = "1 worker" if n_workers == 1 else f"{n_workers} workers"
        self._bar.write(
            f"{self._out}: {n_episodes} episodes, {n_finished} of them finished before; starting {workers}"
        )
        if self._capture.needs_images:
            sim_backend = plan.jobs[0].group.env.sim_backend
            self._bar.write(capture_cost(self._capture, sim_backend=sim_backend))
        self._n_done, self._n_total = n_finished, n_episodes
        self._bar.begin(n_done=n_finished, n_total=n_episodes)
        self._bar.doing("starting processes, loading simulator and policies")
        # The table at the end needs it, and here is nothing to do until a worker has started.
        threading.Thread(target=importlib.import_module, args=("scipy.stats",)).start()

    def on_device(self, device: Mapping[str, str]) -> None:
        """Say that the first simulator is there, and what renders its images."""
        renderer = device.get("render_device")
        self._bar.doing(f"rendering on {renderer}" if renderer else "simulating")

    def on_warning(self, line: str) -> None:
        """Say it at once."""
        self._bar.write(f"warning: {line}")

    def on_record(self, record: EpisodeRecord) -> None:
        """Count the record; say at once what went wrong."""
        self._has_enough = self._has_enough or self._is_enough(record)
        self._lines.on_record(record)
        self._n_done += 1
        if record.error is not None:
            self._n_errors += 1
            where = f"{record.policy} on {record.task}, seed {record.seed}, run {record.run}"
            self._bar.write(f"error: {where}: {record.error.kind}: {record.error.message}")
        elif record.success_once is not None:
            self._successes.setdefault(record.policy, []).append(bool(record.success_once))
        note = f"{success_text(self._successes)}errors {self._n_errors}"
        self._bar.advance(n_done=self._n_done, n_steps=record.n_steps or 0, note=note)

    def on_tick(self) -> bool:
        """As for every bar; the run also stops once it has enough."""
        return super().on_tick() or self._has_enough

    def on_load(self, load: Load) -> None:
        """Show steps as they are executed, and of a cluster its queue and its machines."""
        self._lines.on_load(load)
        self._bar.load(load_text(load, n_open=self._n_total - self._n_done), n_steps=load.n_counted)


class RecordingProgress(_BarAndLines[PhaseLines]):
    """A `RecordingObserver`; all but mismatches goes to standard error."""

    def __init__(self, stop: StopRequest, *, json_progress: int | None = None) -> None:
        lines = JsonLines(json_progress)
        super().__init__(stop, PhaseLines(lines), is_quiet=lines.is_stderr)

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
