"""`--json-progress FD`: JSON objects, one per line (`docs/evaluation.md`); what is not known is null."""

import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vla_eval.evaluation.plan import Plan
from vla_eval.plain_text import printable
from vla_eval.records import EpisodeKey, EpisodeRecord
from vla_eval.storage.run_folder import read_run
from vla_eval.workers.load import Load

logger = logging.getLogger(__name__)

FORMAT_VERSION = 1
"""Of the lines. Raise it when a field changes its meaning."""

STDERR = 2
EVERY_SECONDS = 1.0  # between two lines `progress`


class JsonLines:
    """Writes lines to a file descriptor, if any; a reader that is gone does not stop the run."""

    def __init__(self, descriptor: int | None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.descriptor = descriptor
        self.clock = clock
        if descriptor is not None and descriptor > STDERR:
            os.set_inheritable(descriptor, False)  # a worker that lives on would keep the reader waiting

    @property
    def is_stderr(self) -> bool:
        """Whether messages for people go to the same place, and so are left out."""
        return self.descriptor == STDERR

    def write(self, event: str, fields: dict[str, Any]) -> None:  # Any: plain data
        """Write one line."""
        if self.descriptor is None:
            return
        line = json.dumps({"format_version": FORMAT_VERSION, "event": event, **fields}, allow_nan=False)
        data = f"{printable(line)}\n".encode()  # of the control characters, JSON leaves one (DEL)
        try:
            while data:
                data = data[os.write(self.descriptor, data) :]
        except OSError as exc:
            logger.warning("--json-progress %d: no more lines (%s)", self.descriptor, exc.strerror)
            self.descriptor = None


class _Lines:
    """How far one run, or one phase of a recording, has come."""

    def __init__(self, lines: JsonLines, run: str, phase: str | None) -> None:
        self._lines = lines
        self._start(run, phase)

    def _start(self, run: str, phase: str | None) -> None:
        self._begun = self._written = self._lines.clock()
        self._n_before = 0
        self._is_ended = False
        self._state: dict[str, Any] = {"run": run, "phase": phase}  # Any: plain data

    def _begin(self, *, n_done: int, n_total: int, **more: Any) -> None:
        """Write the first line; `more` are fields that only some kinds of runs know."""
        self._n_before = n_done
        self._state |= {"episodes_done": n_done, "episodes_total": n_total}
        self._state |= {"steps_done": None, "steps_total": None, "successes": None, "errors": None, **more}
        self._write("begin")

    def on_tick(self) -> None:
        """Write a line if it is time."""
        if "episodes_total" in self._state and self._lines.clock() - self._written >= EVERY_SECONDS:
            self._write("progress")

    def close(self, *, stopped: bool) -> None:
        """Write the last line."""
        if "episodes_total" in self._state and not self._is_ended:
            self._is_ended = True
            self._state["stopped"] = stopped
            self._write("end")

    def _note(self, event: str, fields: dict[str, Any]) -> None:
        self._lines.write(event, {"run": self._state["run"], "phase": self._state["phase"], **fields})

    def _write(self, event: str) -> None:
        self._written = self._lines.clock()
        elapsed = self._written - self._begun
        n_here = self._state["episodes_done"] - self._n_before
        n_left = self._state["episodes_total"] - self._state["episodes_done"]
        remaining = 0.0 if not n_left else round(elapsed / n_here * n_left, 1) if n_here else None
        times = {"elapsed_seconds": round(elapsed, 1), "remaining_seconds": remaining}
        self._lines.write(event, {**self._state, **times})


class EvaluationLines(_Lines):
    """The lines of an evaluation; its methods are those of `EvaluationObserver`."""

    def __init__(self, lines: JsonLines, *, out: Path) -> None:
        super().__init__(lines, str(out), None)
        self._folder = out
        self._open_steps: dict[EpisodeKey, int] = {}  # episode without a result -> its horizon

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        """Write what there is to do."""
        if self._lines.descriptor is None:
            return
        records = read_run(self._folder).records if n_finished else ()
        finished = {record.key: record.n_steps or 0 for record in records if record.error is None}
        horizons = {job.key: job.group.offered.horizon_steps for job in plan.jobs}
        self._open_steps = {key: steps for key, steps in horizons.items() if key not in finished}
        self._begin(
            n_done=n_finished,
            n_total=len(plan.jobs),
            steps_done=sum(finished.values()),
            steps_total=sum(finished.values()) + sum(self._open_steps.values()),
            successes=sum(bool(record.success_once) for record in records),
            errors=0,
            workers=n_workers,
            steps_running=None,
            queue=None,
            machines=None,
            left_out=list(plan.left_out),
        )

    def on_record(self, record: EpisodeRecord) -> None:
        """Count the record; write a line about an error."""
        if self._lines.descriptor is None:
            return
        state = self._state
        state["episodes_done"] += 1
        if record.error is None:
            steps = record.n_steps or 0
            state["steps_done"] += steps
            # An episode that ended early leaves less to do.
            state["steps_total"] += steps - self._open_steps[record.key]
            state["successes"] += bool(record.success_once)
        else:
            state["errors"] += 1
            error = {name: getattr(record.error, name) for name in ("kind", "stage", "message")}
            self._note("error", {"episode": record.key._asdict(), **error})

    def on_load(self, load: Load) -> None:
        """Take what the workers are doing into the next line."""
        if self._lines.descriptor is None:
            return
        state = self._state
        n_open = state["episodes_total"] - state["episodes_done"]
        state["steps_running"] = load.n_counted
        state["queue"] = max(0, n_open - load.n_running)
        if load.machines:
            state["machines"] = [asdict(machine) for machine in load.machines]


class PhaseLines(_Lines):
    """The lines of a recording or a replay, phase by phase."""

    def __init__(self, lines: JsonLines) -> None:
        super().__init__(lines, "", None)

    def on_phase(self, task: str, phase: str, *, n_done: int, n_total: int) -> None:
        """End the last phase and begin this one."""
        self.close(stopped=False)
        self._start(task, phase)
        self._begin(n_done=n_done, n_total=n_total)

    def on_progress(self, *, n_done: int) -> None:
        """Count."""
        self._state["episodes_done"] = n_done

    def on_mismatch(self, sentence: str) -> None:
        """Write a line about it."""
        self._note("mismatch", {"message": sentence})
