"""The grid of a probe: what is run, what a K lets a policy see, and which drops chunk and phase explain."""

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import RecipeError
from vla_eval.probe.grid import Axis, GridSettings, GridWorld, plan_grid
from vla_eval.probe.grid_table import grid_table
from vla_eval.probe.grid_text import grid_notes, grid_sentences, render_grid
from vla_eval.probe.phases import fixed_phases, inferences
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.tasks.catalog import task_spec

pytestmark = pytest.mark.usefixtures("in_this_process")

TASK = "RememberColor3-v0"
FAKE = ["--set", "simulator=fake", "--workers", "1"]
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def config(**fields: Any) -> EvalConfig:
    return EvalConfig(**{"name": "x", "tasks": (TASK,), "policies": ("hold",), **fields})


def planned(*sizes: int, **settings: Any) -> list[tuple[int, int, tuple[int, ...] | None]]:
    """(length, first inference, K …) of each evaluation."""
    grid = plan_grid(config(n_action_steps=sizes), GridSettings(**settings))
    return [(one.level, one.first_inference_step, one.config.n_action_steps) for one in grid.worlds]


def test_every_first_inference_is_run_where_k_does_not_divide_the_phases() -> None:
    # Cue and delay have 5 steps each: 1 and 5 divide both, 2 divides neither.
    assert planned(1, 2, 5, delays=(5,)) == [(5, 0, (1, 2, 5)), (5, 1, (2,))]
    # With a delay of 7, 5 divides the cue but not the response at step 12.
    assert [first for _, first, sizes in planned(5, delays=(7,)) if sizes == (5,)] == [0, 1, 2, 3, 4]
    assert planned(4, delays=(5,), first_inferences=(0, 3, 9)) == [(5, 0, (4,)), (5, 3, (4,))]


def test_the_response_has_as_many_steps_at_each_length() -> None:
    grid = plan_grid(
        config(n_action_steps=(1,)), GridSettings(axes=("delay", "cue"), delays=(0, 80), cues=(1,))
    )
    # 60 steps with a cue of 5 and a delay of 5.
    assert [(one.axis, one.config.env) for one in grid.worlds] == [
        ("delay", {"delay_steps": 0, "horizon_steps": 55}),
        ("delay", {"delay_steps": 80, "horizon_steps": 135}),
        ("cue", {"cue_steps": 1, "horizon_steps": 56}),
    ]
    assert [one.config.name for one in grid.worlds][-1] == f"{TASK}_grid_cue_1_from_0"
    assert grid.worlds[0].config.policies == ("hold", "oracle", "cue_reader")
    assert grid.n_episodes == 3 * 3 * 100


@pytest.mark.parametrize(
    ("k", "first", "in_cue", "n_late"),
    # The cue has steps 0 to 4, the response begins at step 10.
    [
        (4, 0, (0, 4), 2),  # 0, 4, 8, 12
        (4, 1, (1,), 3),  # 1, 5, 9, 13
        (4, 2, (2,), 0),  # 2, 6, 10
        (8, 5, (), 3),  # 5, 13
        (20, 12, (), 2),  # 12: until then the arm holds still
    ],
)
def test_a_first_inference_moves_what_is_seen_of_the_cue_and_what_is_late(
    k: int, first: int, in_cue: tuple[int, ...], n_late: int
) -> None:
    phases = fixed_phases(task_spec(TASK), {})
    assert inferences(phases, k, first_inference_step=first) == (in_cue, n_late)


def test_an_inference_between_two_items_sees_none_of_them() -> None:
    # Three cubes for 2 steps each, with 3 empty steps between two: cubes at 0 1, 5 6 and 10 11.
    phases = fixed_phases(task_spec("ChainOfColors3-v0"), {"cue_steps": 2, "gap_steps": 3})
    assert inferences(phases, 1).cue_steps == (0, 1, 5, 6, 10, 11)
    assert inferences(phases, 4).cue_steps == (0,)  # 0, 4, 8
    assert inferences(phases, 4, first_inference_step=2).cue_steps == (6, 10)  # 2, 6, 10


def test_a_grid_runs_on_its_own_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["probe", "--grid", "--task", TASK, "--policy", "hold", *FAKE, "--episodes", "6"]
    out = tmp_path / "grid"
    # The response begins at step 10; the oracle needs 20 steps more if its first chunk is 5 steps late.
    command += ["--set", "env.horizon_steps=36"]
    command += ["--n-action-steps", "1", "8", "--delay", "5", "--out", str(out), "--format"]
    assert main([*command, "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    cells = {(one["policy"], one["n_action_steps"]): one for one in found["cells"]}
    assert list(cells) == [(policy, k) for policy in ("hold", "oracle", "cue_reader") for k in (1, 8)]
    assert {one["length_steps"] for one in cells.values()} == {5}

    reader = cells["cue_reader", 8]["first_inferences"]
    assert [one["cue_inference_steps"] for one in reader] == [[0], [1], [2], [3], [4], [], [], []]
    assert [one["n_cue_frames_seen"] for one in reader] == [1, 1, 1, 1, 1, 0, 0, 0]
    # It knows the cue at the first five, and guesses among three at the others.
    assert [one["n_success_once"] for one in reader[:5]] == [6] * 5
    (guessed,) = {one["n_success_once"] for one in reader[5:]}
    assert guessed < 6
    assert cells["cue_reader", 8]["success_once"] == pytest.approx((5 * 6 + 3 * guessed) / 48)
    assert cells["oracle", 8]["success_once"] == 1.0
    assert (cells["hold", 8]["reference"], cells["oracle", 8]["reference"]) == ("cue_reader", None)
    assert cells["hold", 8]["reference_success_once"] == cells["cue_reader", 8]["success_once"]
    assert (tmp_path / f"grid_{TASK}_delay.png").read_bytes().startswith(PNG_SIGNATURE)

    for style in ("csv", "markdown"):
        assert main([*command, style]) == 0
        output = capsys.readouterr()
        assert output.err.count("episodes are there") == 8  # one folder for each first inference
        if style == "csv":
            rows = list(csv.DictReader(io.StringIO(output.out)))
    # A row for each of the six cells, and one for each of its first inferences.
    assert len(rows) == 3 * (2 + 1 + 8)
    assert [row["first_inference_step"] for row in rows[:4]] == ["", "0", "", "0"]
    assert "| 0 to 7 | 0; 1; 2; 3; 4; none; none; none | 0 to 1 of 5 | 0 to 7 |" in " ".join(
        output.out.split()
    )


def record(policy: str, k: int, seed: int, *, is_success: bool, n_frames: int) -> EpisodeRecord:
    return EpisodeRecord(
        task=TASK,
        policy=policy,
        n_action_steps=k,
        run=0,
        seed=seed,
        outcome="success" if is_success else "failure",
        success_once=is_success,
        n_steps=60,
        n_inferences=60 // k,
        n_frames=n_frames,
        target=0,
        n_candidates=3,
        first_choice=0 if is_success else 1,
        first_choice_success=is_success,
        chance_success=1 / 3,
    )


def grid_of(counts: dict[str, tuple[int, int]], *, reads_every: bool = False, axis: Axis = "delay") -> Any:
    """A grid of K = 1 and K = 4: policy -> successes in 40 episodes at each."""
    found: list[EpisodeRecord] = []
    for policy, of_each in counts.items():
        for k, n in zip((1, 4), of_each, strict=True):
            n_frames = 57 if reads_every and policy == "p" else 60 // k
            found += [record(policy, k, seed, is_success=seed < n, n_frames=n_frames) for seed in range(40)]
    phases = fixed_phases(task_spec(TASK), {})
    world = GridWorld(task=TASK, axis=axis, level=5, first_inference_step=0, phases=phases, config=config())
    return grid_table([world], [found])


def test_a_drop_is_one_of_chunk_and_phase_if_an_oracle_of_the_same_inferences_falls_as_low() -> None:
    # Of 40: 40, 14 and 8 are far from each other (Wilson: from 0.91; to 0.51; to 0.35), 14 and 13 are not.
    alone = grid_of({"p": (40, 13), "cue_reader": (40, 14), "oracle": (40, 40)})
    (sentence,) = grid_sentences(alone)
    assert "p on RememberColor3-v0 succeeds in 0.33 at K = 4, delay 5, and in 1.00 at K = 1" in sentence
    assert "cue_reader, which has the same inferences" in sentence
    assert "falls, too, from 1.00 to 0.35: chunk and phase alone explain the drop, not memory" in sentence

    (sentence,) = grid_sentences(grid_of({"p": (40, 14), "cue_reader": (40, 40)}))
    assert "chunk and phase do not explain the drop" in sentence
    (sentence,) = grid_sentences(grid_of({"p": (40, 1), "cue_reader": (40, 14)}))
    assert "explain a part of the drop, not all of it" in sentence
    assert grid_sentences(grid_of({"p": (40, 38), "cue_reader": (40, 14)})) == []  # no drop to explain


def test_a_drop_by_slow_inferences_is_one_of_motion_or_of_missed_frames_of_the_cue() -> None:
    (sentence,) = grid_sentences(
        grid_of({"p": (40, 13), "cue_reader": (40, 14), "oracle": (40, 40)}, axis="latency")
    )
    assert "at K = 4, inference 5, receding_horizon, and in 1.00 at K = 1" in sentence
    assert "cue_reader, which has the same inferences, falls, too, from 1.00 to 0.35" in sentence
    assert "frames of the cue that no inference fell into explain the drop, not motion" in sentence

    of_motion = grid_of({"p": (40, 13), "cue_reader": (40, 14), "oracle": (40, 14)}, axis="latency")
    (sentence,) = grid_sentences(of_motion)
    assert "oracle, which knows all, falls, too, from 1.00 to 0.35: slow inferences cost motion" in sentence
    neither = grid_of({"p": (40, 13), "cue_reader": (40, 40), "oracle": (40, 40)}, axis="latency")
    (sentence,) = grid_sentences(neither)
    assert "neither motion nor missed frames of the cue explain the drop" in sentence


class TestLatency:
    SETTINGS = GridSettings(axes=("latency",), latencies=(0, 2), modes=("receding_horizon", "wait"))

    def test_each_latency_is_run_in_each_mode_at_every_first_inference(self) -> None:
        grid = plan_grid(config(n_action_steps=(1, 2)), self.SETTINGS)

        found = [
            (w.chunking.mode, w.level, w.first_inference_step, w.config.n_action_steps) for w in grid.worlds
        ]
        assert found == [
            (mode, level, first, sizes)
            for mode in ("receding_horizon", "wait")
            for level in (0, 2)
            for first, sizes in ((0, (1, 2)), (1, (2,)))
        ]
        assert all(world.config.chunking == world.chunking for world in grid.worlds)
        assert [world.chunking.delay for world in grid.worlds] == [world.level for world in grid.worlds]
        assert len({world.config.name for world in grid.worlds}) == 8

    def test_what_chunks_are_too_short_for_is_left_out_and_said(self) -> None:
        grid = plan_grid(config(n_action_steps=(2, 4)), self.SETTINGS, chunk_size=4)

        sizes = {(w.chunking.mode, w.level): w.config.n_action_steps for w in grid.worlds[:]}
        assert sizes["receding_horizon", 2] == (2,)  # 4 + 2 actions are more than 4
        assert sizes["wait", 2] == (4,)  # the last first inference; a chunk waits for nothing
        assert grid.left_out == (
            f"{TASK}: K = 4 with a latency of 2 (receding_horizon): chunks have 4 actions",
        )

    def test_a_task_without_phases_has_one_too(self) -> None:
        grid = plan_grid(config(tasks=("TakeItBack-v0",), n_action_steps=(4,)), self.SETTINGS)

        assert [world.first_inference_step for world in grid.worlds] == [0] * 4
        assert grid.worlds[0].config.policies == ("hold", "oracle")

    def test_slower_inferences_see_less_of_the_cue_and_answer_later(self) -> None:
        worlds = plan_grid(config(n_action_steps=(2,)), self.SETTINGS).worlds
        found = grid_table(
            [w for w in worlds if w.first_inference_step == 0 and w.chunking.mode == "wait"],
            [[record("p", 2, 1, is_success=True, n_frames=30)]] * 2,
        )
        parts = {cell.level: cell.parts[0].inferences for cell in found.cells}

        # The cue has steps 0 to 4, the response begins at step 10. Every 2 steps: 0, 2, 4, and 10.
        assert parts[0] == ((0, 2, 4), 0)
        # Every 2 + 2 steps, since the arm waits: 0, 4, then 12, whose chunk arrives at step 14.
        assert parts[2] == ((0, 4), 4)


def test_a_grid_has_the_formats_of_other_tables() -> None:
    table = grid_of({"p": (40, 13), "cue_reader": (40, 14)})
    latex, page = render_grid(table, "latex"), render_grid(table, "html-table")
    assert "\\toprule" in latex and "cue\\_reader" in latex
    assert (
        page.startswith("<p>All rows: task RememberColor3-v0, chance 0.33.</p>\n<table>")
        and page.count("<tr>") == 1 + 4
    )


def test_a_policy_that_reads_every_frame_is_compared_with_the_oracle() -> None:
    table = grid_of({"p": (40, 14), "cue_reader": (40, 14), "oracle": (40, 40)}, reads_every=True)
    (sentence,) = grid_sentences(table)
    assert "oracle, which has the same inferences" in sentence
    assert "chunk and phase do not explain the drop" in sentence
    assert [cell.parts[0].n_seen for cell in table.cells if cell.policy == "p"] == [5, 5]
    assert [cell.parts[0].n_seen for cell in table.cells if cell.policy == "cue_reader"] == [5, 2]


def test_errors_are_in_no_rate_and_without_a_result_nothing_is_known() -> None:
    error = EpisodeRecord(
        task=TASK,
        policy="p",
        n_action_steps=4,
        run=0,
        seed=1,
        outcome="error",
        error=EpisodeError(kind="WorkerCrashed", stage="step", message="gone"),
    )
    world = dataclasses.replace(plan_grid(config(n_action_steps=(4,)), GridSettings(delays=(5,))).worlds[0])
    table = grid_table([world], [[error]])
    (cell,) = table.cells
    assert (cell.rate, cell.interval, cell.chance, cell.n_errors) == (None, None, None, 1)
    assert cell.parts[0].n_seen is None
    assert any("p: no episode has a result" in note for note in grid_notes(table))
    assert any("1 episodes ended in an error" in note for note in grid_notes(table))


def test_mistakes_in_a_grid_are_said_before_anything_is_run(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecipeError, match="no phases"):
        plan_grid(config(tasks=("TakeItBack-v0",)), GridSettings())
    with pytest.raises(RecipeError, match="needs phases of a fixed length"):
        plan_grid(config(env={"cue_steps": [1, 5]}), GridSettings())
    with pytest.raises(RecipeError, match="no K has one of these first inferences"):
        plan_grid(config(n_action_steps=(1,)), GridSettings(first_inferences=(3,)))
    base = ["probe", "--task", TASK, "--policy", "hold"]
    for arguments, said in (
        (["--grid", "--probe", "swap"], "--probe swap: expected delay or cue"),
        (["--grid", "--swap", "2"], "--grid has no --swap"),
        (["--grid", "--late", "5", "--mask", "cue"], "--grid has no --mask, --late"),
        (["--first-inference", "2"], "Add --grid"),
        (["--grid", "--set", "chunking.first_inference_step=0", "--first-inference", "-1"], "number ≥ 0"),
    ):
        assert main([*base, *arguments]) == 1
        assert said in capsys.readouterr().err
