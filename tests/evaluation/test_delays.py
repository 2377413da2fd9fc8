"""Inference delays as data: no record depends on how a run is made, and a measured one can be replayed."""

import json
from typing import Any

import pytest

from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import TASK, Bench
from tests.evaluation.resolved import fingerprint, make_plan
from vla_eval.cli.main import main
from vla_eval.control_modes import CONTROL_MODES
from vla_eval.errors import RecipeError, RunChangedError

pytestmark = pytest.mark.usefixtures("light_workers")

bench = evaluation_bench.bench

DRAWN = {"steps": [0, 1, 3], "p": [0.5, 0.3, 0.2]}


@pytest.fixture
def pair(bench: Bench) -> Bench:
    bench.write_policy("pair_policy:make")
    return bench


def run(bench: Bench, out: str, chunking: dict[str, Any], **fields: Any) -> list[str]:
    summary = bench.run(out, chunking=chunking, n_action_steps=[2], **fields)
    assert (summary.n_open, summary.n_errors) == (0, 0)
    return bench.lines(out)


@pytest.mark.parametrize("mode", ["receding_horizon", "temporal_ensemble", "wait"])
@pytest.mark.parametrize("delay", [2, DRAWN])
def test_records_are_the_same_for_any_number_of_workers_and_slots(
    pair: Bench, mode: str, delay: object
) -> None:
    chunking = {"mode": mode, "delay": delay}
    alone = run(pair, "alone", chunking)

    assert run(pair, "beside", chunking, slots_per_worker=4) == alone
    assert run(pair, "workers", chunking, workers=2) == alone
    records = pair.records("alone")
    assert all((one.delay_steps is None) == (delay == 2) for one in records.values())
    if delay == 2:  # the chunks of two steps are held for at least once
        assert all(one.n_held_steps for one in records.values())


def test_episodes_of_one_seed_have_the_same_delays_whatever_the_policy(pair: Bench) -> None:
    pair.run(
        "out",
        chunking={"delay": DRAWN},
        n_action_steps=[1],
        policies=["random", str(pair.folder / "night.yaml")],
    )
    rows = [json.loads(line) for line in pair.lines("out")]
    by_seed: dict[int, set[tuple[int, ...]]] = {}
    for row in rows:
        by_seed.setdefault(row["seed"], set()).add(tuple(row["delay_steps"]))

    assert len(rows) == 12
    assert all(len(delays) == 1 for delays in by_seed.values())
    assert len(set().union(*by_seed.values())) > 1


class TestTraces:
    def test_a_measured_run_can_be_played_again_to_the_bit(self, bench: Bench) -> None:
        bench.write_policy(pause=0.07)  # more than one control step of 50 ms
        measured = run(bench, "measured", {"delay": "measured"}, episodes=3)
        trace = {"delay": {"trace": str(bench.folder / "measured")}}
        bench.write_policy()  # on a faster machine

        assert run(bench, "played", trace, episodes=3) == measured
        delays = [one.delay_steps for one in bench.records("measured").values()]
        assert all(own and min(own) >= 2 for own in delays)

    def test_a_trace_is_played_the_same_however_the_run_is_made(self, pair: Bench) -> None:
        run(pair, "drawn", {"delay": DRAWN}, episodes=3)
        trace = {"delay": {"trace": str(pair.folder / "drawn")}}
        alone = run(pair, "alone", trace)  # three episodes are in the trace, three are not

        assert run(pair, "beside", trace, slots_per_worker=4) == alone
        assert run(pair, "workers", trace, workers=2) == alone
        assert alone[:3] == pair.lines("drawn")

    def test_what_is_played_is_said(self, pair: Bench) -> None:
        run(pair, "drawn", {"delay": DRAWN}, episodes=2)
        config = pair.config(
            chunking={"delay": {"trace": str(pair.folder / "drawn")}}, n_action_steps=[2], episodes=6
        )

        note, _lost = make_plan(config).notes
        assert "drawn has 2 of these 6 episodes" in note

    def test_a_run_is_not_continued_with_another_trace_of_the_same_name(self, pair: Bench) -> None:
        for folder, delay in (("a", DRAWN), ("b", {"steps": [1, 2]})):
            run(pair, f"{folder}/drawn", {"delay": delay}, episodes=2)
        run(pair, "out", {"delay": {"trace": str(pair.folder / "a/drawn")}})

        with pytest.raises(RunChangedError, match="delays/drawn"):
            run(pair, "out", {"delay": {"trace": str(pair.folder / "b/drawn")}})

    def test_a_run_with_one_delay_for_all_is_no_trace(self, pair: Bench) -> None:
        run(pair, "fixed", {"delay": 1}, episodes=1)

        with pytest.raises(RecipeError, match=r"fixed: expected a run whose delays .* found 1 episodes"):
            run(pair, "out", {"delay": {"trace": str(pair.folder / "fixed")}})

    def test_the_flag_names_the_run(self, pair: Bench, capsys: pytest.CaptureFixture[str]) -> None:
        run(pair, "drawn", {"delay": DRAWN}, episodes=2)
        folder, flags = pair.folder, "--episodes 2 --set simulator=fake --set workers=1"
        named = ["--out", str(folder / "out"), "--delay-trace", str(folder / "drawn")]
        code = main(["eval", "--task", TASK, "--policy", "random", *named, *flags.split()])

        assert code == 0
        assert "drawn has 0 of these 2 episodes" in capsys.readouterr().err


def test_it_is_said_where_a_measured_delay_is_that_of_several_episodes(pair: Bench) -> None:
    def notes(**fields: Any) -> list[str]:
        return make_plan(pair.config(chunking={"delay": "measured"}, **fields)).notes

    assert [note for note in notes() if "motion that is lost" not in note] == []
    assert "share passes" in " ".join(notes(slots_per_worker=2))


@pytest.mark.parametrize("mode", CONTROL_MODES)
@pytest.mark.parametrize(
    ("chunking", "skips"),
    [
        ({}, False),
        ({"delay": 1}, True),
        ({"delay": {"steps": [0, 2]}}, True),
        ({"delay": "measured"}, True),
        ({"delay": 1, "delay_alignment": "stale"}, False),
        ({"delay": 1, "mode": "wait"}, False),
    ],
)
def test_it_is_said_where_a_delay_makes_motion_get_lost(
    bench: Bench, mode: str, chunking: dict[str, Any], skips: bool
) -> None:
    env = {"control_mode": mode}  # planned, and not run: the fake simulator has one mode
    config = bench.config(policies=["oracle"], simulator="maniskill", env=env, chunking=chunking)
    notes = make_plan(config).notes
    said = [note for note in notes if "motion that is lost" in note]
    assert len(said) == (skips and "delta" in mode)
    assert all(mode in note for note in said)


@pytest.mark.parametrize("mode", CONTROL_MODES)
@pytest.mark.parametrize("chunking", [{}, {"mode": "temporal_ensemble"}, {"mode": "wait"}])
def test_it_is_said_where_relative_actions_are_averaged(
    bench: Bench, mode: str, chunking: dict[str, Any]
) -> None:
    env = {"control_mode": mode}
    config = bench.config(policies=["oracle"], simulator="maniskill", env=env, chunking=chunking)
    said = [note for note in make_plan(config).notes if "planned from different places" in note]
    assert len(said) == (chunking.get("mode") == "temporal_ensemble" and "delta" in mode)
    assert all(mode in note for note in said)


def test_a_delay_that_is_a_number_is_recorded_as_before_it_could_vary(bench: Bench) -> None:
    """Else runs of earlier versions could not be continued."""
    old = bench.config(chunking={"delay_steps": 1})

    assert fingerprint(old) == fingerprint(bench.config(chunking={"delay": 1}))
    assert fingerprint(bench.config()) != fingerprint(old)


def test_a_policy_that_does_not_join_its_chunks_is_refused_where_it_has_to(pair: Bench) -> None:
    summary = None
    with pytest.raises(Exception, match=r"does not read what is committed.*mode=rtc"):
        summary = pair.run("out", chunking={"mode": "rtc"})
    assert summary is None


# Its chunk continues what is committed: what was lost on the way would show.
JOINING_MODULE = """
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

CHUNK = 6


class Policy:
    def __init__(self, context):
        self.spec = PolicySpec(name="joins", reads="last", cameras=(), states=("qpos",), chunk_size=CHUNK,
                               reads_committed=context.chunking.execution.commits)
        self.rng = {}

    def reset(self, episodes):
        self.rng.update({e.slot: np.random.default_rng([e.seed, e.run]) for e in episodes})

    def act_batch(self, windows):
        return [self.act(window) for window in windows]

    def act(self, window):
        told, actions = window.committed, self.rng[window.slot].uniform(-1, 1, (CHUNK, 7)).astype(np.float32)
        if told is not None:
            actions[: len(told.actions)] = told.actions * np.float32(0.5)
            actions[: told.n_frozen] = told.actions[: told.n_frozen]
        return ActionChunk(actions=actions)


def make(context, *, checkpoint):
    return Policy(context)
"""


@pytest.mark.parametrize("delay", [1, DRAWN])
def test_what_is_committed_reaches_the_policy_over_a_socket_as_it_does_in_process(
    bench: Bench, delay: object
) -> None:
    (bench.folder / "join_policy.py").write_text(JOINING_MODULE)
    bench.write_policy("join_policy:make", checkpoint="none")
    chunking = {"mode": "rtc", "delay": delay}
    alone = run(bench, "alone", chunking)

    assert run(bench, "beside", chunking, slots_per_worker=4) == alone
    shared = {"inference": "shared", "inference_max_batch": 4, "workers": 2}
    assert run(bench, "served", chunking, **shared) == alone
    assert run(bench, "untold", {"delay": delay}) != alone
