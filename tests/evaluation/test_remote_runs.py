"""Whole runs with a policy behind a socket: same records for any workers; no failure when it goes away."""

import json
import threading
from collections.abc import Callable
from typing import Any

import pytest

from tests.evaluation.evaluation_bench import Bench
from tests.evaluation.evaluation_bench import bench as bench
from tests.evaluation.resolved import make_plan
from tests.wire.small_servers import SmallServer, serving
from vla_eval.cli.main import main
from vla_eval.errors import (
    RecipeError,
    RemoteChangedError,
    RemoteConnectionError,
    RunChangedError,
    TooManyErrorsError,
)
from vla_eval.results.report import build_table
from vla_eval.storage.run_folder import read_run

STEPS = 4  # of a chunk, all executed


def evaluate(bench: Bench, out: str, url: str, **fields: Any) -> Any:
    return bench.run(out, **{"policies": [url], "n_action_steps": [STEPS], "episodes": 6, **fields})


def outcomes(bench: Bench, out: str) -> dict[int, str]:
    return {seed: record.outcome for seed, record in bench.records(out).items()}


def test_records_are_the_same_for_any_workers_slots_and_servers(bench: Bench) -> None:
    with serving(SmallServer()) as url:
        for workers, slots in ((1, 1), (2, 1), (1, 3)):
            summary = evaluate(bench, f"{workers}x{slots}", url, workers=workers, slots_per_worker=slots)
            assert (summary.n_open, summary.n_errors) == (0, 0)
    assert bench.lines("1x1") == bench.lines("2x1") == bench.lines("1x3")
    seeds = {record.trajectory_sha256 for record in bench.records("1x1").values()}
    assert len(seeds) == 6  # the server knows each episode's seed


def test_records_and_run_file_name_the_server(bench: Bench) -> None:
    with serving(SmallServer(n_sessions=3)) as url:
        evaluate(bench, "out", url)
    run = json.loads((bench.folder / "out" / "run.json").read_text())
    name = f"small@{url.removeprefix('ws://').replace(':', '-')}"
    assert {record.policy for record in bench.records("out").values()} == {name}
    assert run["servers"][name]["weights_sha256"] == run["recipes"][f"checkpoints/{name}"] == "ab" * 32
    assert "n_sessions" not in run["servers"][name]


def test_rows_follow_the_index_modulo_what_the_server_says(bench: Bench) -> None:
    server = SmallServer(batch_max=2)
    with serving(server) as url:
        plan = make_plan(bench.config(policies=[url], n_action_steps=[STEPS], episodes=5, slots_per_worker=3))
        evaluate(bench, "out", url, episodes=5, slots_per_worker=3)
    assert [job.row for job in plan.jobs] == [0, 1, 0, 1, 0]
    assert [job.slot for job in plan.jobs] == [0, 1, 2, 0, 1]
    resets = {one["seed"]: one["row"] for one in server.requests if one["endpoint"] == "reset"}
    assert resets == {1: 0, 2: 1, 3: 0, 4: 1, 5: 0}


def test_a_recipe_with_another_address_keeps_its_name_and_its_run(bench: Bench) -> None:
    bench.write_policy("remote", url="ws://127.0.0.1:9", chunk_size=STEPS)
    recipe = str(bench.folder / "night.yaml")
    with serving(SmallServer()) as url:
        evaluate(bench, "out", f"{recipe}@{url}", episodes=3)
    with serving(SmallServer()) as url:  # at another port
        summary = evaluate(bench, "out", f"{recipe}@{url}", episodes=3)
    assert (summary.n_open, summary.n_errors) == (0, 0)
    assert {record.policy for record in bench.records("out").values()} == {"night"}


def test_a_recipe_of_another_adapter_cannot_be_moved_to_an_address(bench: Bench) -> None:
    with pytest.raises(RecipeError, match="adapter 'remote', found the adapter 'night_policy:make'"):
        evaluate(bench, "out", f"{bench.folder / 'night.yaml'}@ws://127.0.0.1:9")


def test_servers_of_different_policies_are_not_one_policy(bench: Bench) -> None:
    with (
        serving(SmallServer()) as first,
        serving(SmallServer(weights_sha256="00" * 32)) as second,
        pytest.raises(RemoteChangedError, match=second),
    ):
        evaluate(bench, "out", f"{first},{second}")


def test_planning_asks_a_server_once(bench: Bench) -> None:
    bench.write_policy("remote", url="ws://127.0.0.1:9", chunk_size=STEPS)
    task = ["--task", "RememberColor3-v0", "--set", "simulator=fake"]
    for recipe in ("", f"{bench.folder / 'night.yaml'}@"):
        server = SmallServer()
        with serving(server) as url:
            assert main(["eval", *task, "--policy", f"{recipe}{url}", "--dry-run"]) == 0
            assert server.n_connections == 1
            make_plan(bench.config(policies=[f"{recipe}{url}"]))
            assert server.n_connections == 2


def test_a_run_with_a_baseline_asks_a_server_once_before_its_worker_does(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    server = SmallServer()
    with serving(server) as url:
        name = f"small@{url.removeprefix('ws://').replace(':', '-')}"
        common = ["eval", "--task", "RememberColor3-v0", "--policy", url, "hold", "--episodes", "1"]
        fake = ["--workers", "1", "--set", "simulator=fake", "--out", str(bench.folder / "out")]
        assert main([*common, *fake, "--baseline", name]) == 0
        assert server.n_connections == 2  # of the plan, and of the only worker
        assert main([*common, *fake, "--baseline", "smal"]) == 1
    assert f"Known: hold, {name}" in capsys.readouterr().err


def test_seeds_that_a_server_was_trained_on_are_warned_of(bench: Bench) -> None:
    with serving(SmallServer(training_seeds={"RememberColor3-v0": [[3, 40]]})) as url:
        (warning,) = make_plan(bench.config(policies=[url], episodes=6)).warnings
    assert "trained on demonstrations of 4 of the 6 seeds" in warning  # 3 to 6


def test_checkpoints_of_one_policy_are_no_servers(bench: Bench) -> None:
    bench.write_policy("remote", url="ws://127.0.0.1:9")
    with pytest.raises(RecipeError, match=r"found .*night\.yaml\. Give a policy server"):
        make_plan(bench.config(policies=[f"both={bench.folder / 'night.yaml'},random"]))


def test_without_a_server_the_command_says_so_once_and_leaves_no_folder(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(SmallServer()) as url:
        pass
    out = bench.folder / "out"
    with pytest.raises(RemoteConnectionError):
        evaluate(bench, "out", url)
    assert main(["eval", "--task", "RememberColor3-v0", "--policy", url, "--out", str(out)]) == 1
    assert "Start it (`mikasa-vla serve" in capsys.readouterr().err
    assert not out.exists()


def test_other_weights_are_refused_on_resume(bench: Bench) -> None:
    port = 0
    with serving(SmallServer()) as url:
        evaluate(bench, "out", url, episodes=2)
        port = int(url.rsplit(":", 1)[1])
    before = (bench.folder / "out" / "episodes.jsonl").read_bytes()
    other = SmallServer(versions={"numpy": "1"})
    with (
        serving(other, port=port) as url,
        pytest.raises(RunChangedError, match=r'another policy at the server:\n.*versions\.numpy: "2" -> "1"'),
    ):
        evaluate(bench, "out", url, episodes=2)
    assert (bench.folder / "out" / "episodes.jsonl").read_bytes() == before


def test_a_table_names_the_policies_whose_weights_are_unknown(bench: Bench) -> None:
    known, unknown = SmallServer(), SmallServer(name="secret")
    del unknown.metadata["weights_sha256"]
    with serving(known) as first, serving(unknown) as second:
        evaluate(bench, "known", first, episodes=1)
        evaluate(bench, "unknown", second, episodes=1)
    for out, expected in (("known", False), ("unknown", True)):
        notes = build_table([read_run(bench.folder / out)]).notes
        assert any("weights unknown" in note and "secret@" in note for note in notes) is expected


# ------------------------------------------------------------------------------------------ faults


def failing_at(server: SmallServer, seed: int, *, what: Callable[[], Any]) -> SmallServer:
    """Make the server do something else in the middle of one episode, once."""
    usual = server.usual_answer
    state = {"done": False}

    def answer(request: dict[str, Any]) -> Any:
        reply = usual(request)
        in_episode = server.seeds.get(request["session_id"]) == seed and request["step"] > 0
        if in_episode and not state["done"]:
            state["done"] = True
            return what()
        return reply

    server.answer = answer
    return server


def hang_up() -> Any:
    raise ConnectionError("the server is killed")


def wait_long() -> None:
    """Answer nothing: the client's patience ends."""


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("what", "kind"),
    [
        (hang_up, "RemoteConnectionError"),
        (wait_long, "RemoteTimeoutError"),
        (lambda: "out of memory", "RemoteReplyError"),
        (lambda: {"session_id": "another", "actions": 0}, "RemoteReplyError"),
    ],
)
def test_what_goes_wrong_in_an_episode_is_an_error_that_a_resume_heals(
    bench: Bench, what: Callable[[], Any], kind: str
) -> None:
    bench.write_policy("remote", url="ws://127.0.0.1:9", timeout_seconds=1.0)
    recipe = str(bench.folder / "night.yaml")
    with serving(SmallServer()) as url:
        evaluate(bench, "undisturbed", f"{recipe}@{url}", episodes=3)
    with serving(failing_at(SmallServer(), 2, what=what)) as url:
        summary = evaluate(bench, "out", f"{recipe}@{url}", episodes=3)
        assert summary.n_errors == 1
        assert outcomes(bench, "out")[2] == "error"
        error = bench.records("out")[2].error
        assert error is not None and (error.kind, error.stage) == (kind, "inference")
        assert evaluate(bench, "out", f"{recipe}@{url}", episodes=3).n_errors == 0
    assert bench.lines("out") == bench.lines("undisturbed")


def test_a_run_goes_on_when_the_server_is_back(bench: Bench) -> None:
    """The server ends in the middle and starts again at the same port."""
    bench.write_policy("remote", url="ws://127.0.0.1:9", connect_seconds=20.0)
    recipe, gone = str(bench.folder / "night.yaml"), threading.Event()

    def end() -> Any:
        gone.set()
        raise ConnectionError("the server is killed")

    first = serving(failing_at(SmallServer(), 2, what=end))
    url = first.__enter__()
    port = int(url.rsplit(":", 1)[1])

    def restart() -> None:
        gone.wait(30)
        first.__exit__(None, None, None)
        with serving(SmallServer(), port=port):
            finished.wait(60)

    finished = threading.Event()
    thread = threading.Thread(target=restart)
    thread.start()
    try:
        summary = evaluate(bench, "out", f"{recipe}@{url}", episodes=4)
    finally:
        finished.set()
        thread.join()
    assert (
        1 <= summary.n_errors <= 2
    )  # the episode that ran, and maybe the one before the port was open again
    assert "failure" not in {o for s, o in outcomes(bench, "out").items() if s == 2}
    assert outcomes(bench, "out")[4] != "error"


def test_a_run_stops_when_the_server_stays_away(bench: Bench) -> None:
    bench.write_policy("remote", url="ws://127.0.0.1:9", connect_seconds=0.0)
    server = failing_at(SmallServer(), 2, what=hang_up)
    with serving(server) as url:
        recipe = f"{bench.folder / 'night.yaml'}@{url}"
        original = server.answer

        def refuse_after_the_first(request: dict[str, Any]) -> Any:
            return (
                original(request)
                if server.seeds.get(request["session_id"], request.get("seed")) == 1
                else hang_up()
            )

        server.answer = refuse_after_the_first
        with pytest.raises(TooManyErrorsError, match="RemoteConnectionError"):
            evaluate(bench, "out", recipe, max_consecutive_errors=3)
    assert sorted(outcomes(bench, "out").values()).count("error") == 3


def test_a_server_that_comes_back_with_other_weights_makes_no_results(bench: Bench) -> None:
    server = SmallServer()

    def change() -> Any:
        server.metadata["weights_sha256"] = "00" * 32
        raise ConnectionError("restarted")

    failing_at(server, 2, what=change)
    with serving(server) as url, pytest.raises(TooManyErrorsError, match="other weights"):
        evaluate(bench, "out", url, max_consecutive_errors=3)
    found = outcomes(bench, "out")
    assert found.pop(1) != "error"  # it was finished before
    assert set(found.values()) == {"error"}
