"""Our server stops in the middle of a run and comes back: errors that a resume heals, no failure."""

import json
from collections.abc import Mapping

import pytest

from tests.evaluation.evaluation_bench import Bench
from tests.evaluation.evaluation_bench import bench as bench
from tests.evaluation.resolved import evaluate
from tests.serving.served_policies import CountingPolicy, serving
from vla_eval.errors import TooManyErrorsError
from vla_eval.evaluation.plan import Plan
from vla_eval.records import EpisodeRecord
from vla_eval.workers.load import Load


class StopsAfter:
    """Stops the server after a number of records, as an observer of the run."""

    def __init__(self, server: object, n_records: int) -> None:
        self._server, self._n_left = server, n_records

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        pass

    def on_device(self, device: Mapping[str, str]) -> None:
        pass

    def on_record(self, record: EpisodeRecord) -> None:
        self._n_left -= 1
        if self._n_left == 0:
            self._server.stop()  # type: ignore[attr-defined]
            self._server.wait()  # type: ignore[attr-defined]

    def on_load(self, load: Load) -> None:
        pass

    def on_tick(self) -> bool:
        return False


@pytest.mark.slow
def test_a_restart_in_the_middle_costs_errors_that_a_resume_heals(bench: Bench) -> None:
    def write_recipe(url: str) -> None:
        recipe = {"version": 1, "description": "d", "adapter": "remote"}
        (bench.folder / "night.yaml").write_text(
            json.dumps({**recipe, "args": {"url": url, "connect_seconds": 0.0}})
        )

    fields = {"n_action_steps": [2], "workers": 2, "max_consecutive_errors": 2}
    with serving(CountingPolicy(), n_rows=2) as server:
        port = server.port
        write_recipe(server.url)
        bench.run("undisturbed", **fields)
        with pytest.raises(TooManyErrorsError, match="Remote"):
            evaluate(bench.config(**fields), out=bench.folder / "restarted", observer=StopsAfter(server, 2))
    outcomes = [record.outcome for record in bench.records("restarted").values()]
    assert outcomes.count("error") >= 2
    assert set(bench.lines("restarted")) < set(bench.lines("undisturbed"))

    with serving(CountingPolicy(), n_rows=2, port=port):
        summary = bench.run("restarted", **fields)

    assert (summary.n_open, summary.n_errors) == (0, 0)
    assert bench.lines("restarted") == bench.lines("undisturbed")
