"""Counts of a server, for its log and for Prometheus. Knows nothing of sockets or policies."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

PREFIX = "mikasa_vla"
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Of Prometheus' text format: https://prometheus.io/docs/instrumenting/exposition_formats/"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """What was counted since the start."""

    n_inferences: int = 0
    n_passes: int = 0
    n_errors: int = 0  # inferences or beginnings of episodes at which the policy failed
    infer_seconds: float = 0.0
    # added up over all inferences: between the request and the beginning of its pass
    queue_seconds: float = 0.0


class ServerMetrics:
    """Counts; written by the thread that infers, which also calls `on_pass` with each pass's seconds."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        *,
        on_pass: Callable[[float], None] = lambda _seconds: None,
    ) -> None:
        self._clock, self._on_pass = clock, on_pass
        self._lock = threading.Lock()
        self._counts = Counts()
        self._reported, self._reported_at = Counts(), clock()

    def count_pass(self, *, n_requests: int, infer_seconds: float, queue_seconds: float) -> None:
        """Count a pass; `queue_seconds` is what its requests had waited, added up."""
        with self._lock:
            counts = self._counts
            self._counts = replace(
                counts,
                n_inferences=counts.n_inferences + n_requests,
                n_passes=counts.n_passes + 1,
                infer_seconds=counts.infer_seconds + infer_seconds,
                queue_seconds=counts.queue_seconds + queue_seconds,
            )
        self._on_pass(infer_seconds)

    def count_error(self) -> None:
        """Count an error of the policy."""
        with self._lock:
            self._counts = replace(self._counts, n_errors=self._counts.n_errors + 1)

    @property
    def counts(self) -> Counts:
        """What was counted since the start."""
        with self._lock:
            return self._counts

    def line(self, *, n_sessions: int) -> str:
        """Return one line of statistics since the last call."""
        now, counts, before = self._clock(), self.counts, self._reported
        seconds = now - self._reported_at
        self._reported, self._reported_at = counts, now
        names = [one.name for one in fields(Counts)]
        new = Counts(**{name: getattr(counts, name) - getattr(before, name) for name in names})
        rate = new.n_inferences / seconds if seconds > 0 else 0.0
        return (
            f"sessions {n_sessions}, inferences/s {rate:.2f}, mean batch "
            f"{_shown(new.n_inferences, new.n_passes)}, queue ms "
            f"{_shown(1000 * new.queue_seconds, new.n_inferences)}, pass ms "
            f"{_shown(1000 * new.infer_seconds, new.n_passes)}, errors {new.n_errors}"
        )

    def prometheus(self, *, n_sessions: int, n_connections: int) -> str:
        """Return all counts in Prometheus' text format."""
        counts = self.counts
        rows: tuple[tuple[str, str, str, float], ...] = (
            ("sessions", "gauge", "Sessions at the moment.", n_sessions),
            ("connections", "gauge", "Open connections.", n_connections),
            ("inferences_total", "counter", "Chunks of actions.", counts.n_inferences),
            ("passes_total", "counter", "Calls of the policy.", counts.n_passes),
            ("errors_total", "counter", "Failures of the policy.", counts.n_errors),
            ("infer_seconds_total", "counter", "Time in the policy.", counts.infer_seconds),
            ("queue_seconds_total", "counter", "Time of requests in the queue.", counts.queue_seconds),
        )
        return "".join(
            f"# HELP {PREFIX}_{name} {text}\n# TYPE {PREFIX}_{name} {kind}\n{PREFIX}_{name} {value}\n"
            for name, kind, text, value in rows
        )


def _shown(part: float, whole: float) -> str:
    """Return a mean; a dash where there is nothing to take it of."""
    return f"{part / whole:.2f}" if whole > 0 else "—"
