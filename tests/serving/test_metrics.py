"""Counts of a server: since the start for Prometheus, since the last line for the log."""

from vla_eval.serving.metrics import ServerMetrics


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def test_a_line_is_of_the_time_since_the_last_one() -> None:
    clock = Clock()
    metrics = ServerMetrics(clock=clock)
    metrics.count_pass(n_requests=3, infer_seconds=0.1, queue_seconds=0.06)
    metrics.count_pass(n_requests=1, infer_seconds=0.3, queue_seconds=0.0)
    clock.seconds = 8.0
    # 4 inferences in 8 s and in 2 passes; 60 ms of waiting for 4; 400 ms of passes for 2.
    assert metrics.line(n_sessions=5) == (
        "sessions 5, inferences/s 0.50, mean batch 2.00, queue ms 15.00, pass ms 200.00, errors 0"
    )
    metrics.count_error()
    clock.seconds = 10.0
    assert metrics.line(n_sessions=0) == (
        "sessions 0, inferences/s 0.00, mean batch —, queue ms —, pass ms —, errors 1"
    )


def test_prometheus_gets_all_counts_since_the_start() -> None:
    metrics = ServerMetrics()
    metrics.count_pass(n_requests=3, infer_seconds=0.5, queue_seconds=0.25)
    metrics.line(n_sessions=0)
    lines = metrics.prometheus(n_sessions=2, n_connections=1).splitlines()
    values = dict(line.split(" ") for line in lines if not line.startswith("#"))
    assert values == {
        "mikasa_vla_sessions": "2",
        "mikasa_vla_connections": "1",
        "mikasa_vla_inferences_total": "3",
        "mikasa_vla_passes_total": "1",
        "mikasa_vla_errors_total": "0",
        "mikasa_vla_infer_seconds_total": "0.5",
        "mikasa_vla_queue_seconds_total": "0.25",
    }
