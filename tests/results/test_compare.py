"""Comparing chunk lengths and policies: who is paired with whom, what was seen, how much more is needed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tests.evaluation.resolved import evaluate
from tests.results.stored_runs import stored
from vla_eval.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import load_recipe
from vla_eval.errors import ReportError, UnknownNameError
from vla_eval.latency import EpisodeDelays
from vla_eval.motion import Motion
from vla_eval.records import EpisodeRecord
from vla_eval.results.grouping import RowKey
from vla_eval.results.sweep import (
    Sweep,
    SweepRow,
    compare_runs,
    discordance_of_independent,
    episodes_to_settle,
)
from vla_eval.results.sweep_format import render_sweep
from vla_eval.workers.in_process import IN_PROCESS

TASK = "RememberColor3-v0"


def episodes(
    policy: str, k: int, outcomes: str, *, task: str = TASK, every: bool = False
) -> list[EpisodeRecord]:
    """One episode per letter, seeds from 1: `+` success, `-` failure; 60 steps."""
    n_inferences = -(-60 // k)
    return [
        EpisodeRecord(
            task=task,
            policy=policy,
            n_action_steps=k,
            run=0,
            seed=seed,
            outcome="success" if letter == "+" else "failure",
            success_once=letter == "+",
            n_candidates=3,
            n_inferences=n_inferences,
            n_frames=60 if every else n_inferences,
            trajectory_sha256=f"{policy}/{k}/{seed}",
        )
        for seed, letter in enumerate(outcomes, start=1)
    ]


def row(sweep: Sweep, policy: str, k: int) -> SweepRow:
    (found,) = (row for row in sweep.rows if (row.key.policy, row.key.n_action_steps) == (policy, k))
    return found


def test_each_k_is_compared_with_the_smallest_on_the_same_seeds() -> None:
    sweep = compare_runs([stored(episodes("p", 4, "++--"), episodes("p", 1, "+++-"), episodes("q", 8, "+"))])
    found = row(sweep, "p", 4).comparison
    assert found is not None and found.baseline == RowKey(TASK, "p", 1, None)
    test = found.test
    assert (test.difference, found.pairs.n_pairs) == (-0.25, 4)
    assert test.p_value == 1.0  # one differing pair: two-sided binomial of 0 in 1
    assert row(sweep, "p", 1).comparison is None
    assert row(sweep, "q", 8).comparison is None  # nothing of its own to compare with
    assert sweep.n_comparisons == 1


def test_policies_are_compared_at_the_same_k_and_p_is_corrected_for_all() -> None:
    won, lost = "+" * 8, "-" * 8
    groups = [episodes("good", k, won) for k in (1, 4)] + [episodes("bad", k, lost) for k in (1, 4)]
    sweep = compare_runs([stored(*groups)], by="policy", reference="bad")
    for k in (1, 4):
        found = row(sweep, "good", k).comparison
        assert found is not None and found.baseline == RowKey(TASK, "bad", k, None)
        assert found.test.p_value == pytest.approx(2 * 0.5**8)
        assert found.corrected_p == pytest.approx(2 * 2 * 0.5**8)  # two comparisons


@pytest.mark.parametrize(("k", "seen"), [(1, "5"), (2, "3"), (4, "2"), (5, "1"), (8, "1")])
def test_a_policy_that_reads_the_last_frame_sees_the_cue_when_it_infers(k: int, seen: str) -> None:
    # 5 steps of cue: steps 0 … 4; by the executor itself, steps at which an inference is due.
    spec = ChunkingSpec(n_action_steps=k)
    executor = ChunkExecutor(spec, EpisodeDelays(delay=0, seed=1, control_hz=20.0))
    looked = 0
    for step in range(5):
        if step == executor.next_inference_step:
            looked += 1
            executor.next_inference_step = step + k
    assert str(looked) == seen
    sweep = compare_runs([stored(episodes("p", k, "+-"), episodes("p", 16, "+-"))])
    assert str(row(sweep, "p", k).cue) == seen


def test_a_policy_that_reads_every_frame_sees_the_whole_cue() -> None:
    sweep = compare_runs([stored(*(episodes("p", k, "+-", every=True) for k in (4, 8)))])
    assert str(row(sweep, "p", 8).cue) == "5"


def test_a_cue_shown_in_turn_lasts_for_all_that_is_shown() -> None:
    groups = [episodes("p", k, "+-", task="SeqOfColors7-v0") for k in (4, 16)]
    assert str(row(compare_runs([stored(*groups)]), "p", 16).cue) == "3"  # steps 0, 16, 32 of 0 … 34
    sweep = compare_runs([stored(*groups, env={"cue_steps": 1, "gap_steps": 2})])
    assert str(row(sweep, "p", 4).cue) == "5"  # steps 0, 4, … 16 of 0 … 18: 7 cubes and 6 gaps


def test_a_cue_of_drawn_length_gives_a_range_and_no_cue_gives_none() -> None:
    env = {"cue_steps": [3, 9]}
    sweep = compare_runs([stored(episodes("p", 4, "+-"), episodes("p", 1, "+-"), env=env)])
    assert str(row(sweep, "p", 4).cue) == "1-3"  # steps 0 | 0, 4, 8
    ball = [episodes("p", k, "+-", task="InterceptMedium-v0") for k in (1, 4)]
    assert row(compare_runs([stored(*ball)]), "p", 4).cue is None


def test_the_number_of_episodes_finds_the_difference_as_often_as_promised() -> None:
    difference, discordance, n_draws = 0.15, 0.35, 4000
    n = episodes_to_settle(difference, discordance)
    # Connor's equation by hand: (1.95996 √0.35 + 0.84162 √(0.35 - 0.0225))² / 0.0225 = 119.8.
    assert n == 120
    rng = np.random.default_rng(0)
    more, fewer = (discordance + difference) / 2, (discordance - difference) / 2
    counts = rng.multinomial(n, [more, fewer, 1 - discordance], n_draws)
    z = (counts[:, 0] - counts[:, 1]) / np.sqrt(counts[:, 0] + counts[:, 1])  # McNemar, asymptotic
    found = float(np.mean(np.abs(z) > stats.norm.ppf(0.975)))
    assert found == pytest.approx(0.8, abs=0.03)  # 0.03 is over four standard errors of 4000 draws


def test_more_comparisons_and_smaller_differences_need_more_episodes() -> None:
    assert episodes_to_settle(0.1, 0.2) < episodes_to_settle(0.1, 0.2, level=0.01)
    assert episodes_to_settle(0.1, 0.2) < episodes_to_settle(0.05, 0.2)
    assert episodes_to_settle(0.3, 0.1) == episodes_to_settle(0.3, 0.3)  # they must differ at least so often
    assert discordance_of_independent(0.5, 0.5) == 0.5
    assert discordance_of_independent(1.0, 1.0) == 0.0


def test_mistakes_are_answered() -> None:
    run = stored(episodes("p", 1, "+-"), episodes("p", 4, "+-"))
    with pytest.raises(UnknownNameError, match=r"there is no n_action_steps '3'"):
        compare_runs([run], reference="3")
    with pytest.raises(ReportError, match=r"no two rows share episodes and differ in policy alone"):
        compare_runs([run], by="policy")
    with pytest.raises(ReportError, match=r"--difference is 0"):
        compare_runs([run], difference=0)
    with pytest.raises(ReportError, match=r"no episode with a result"):
        compare_runs([stored([])])


def test_the_text_names_what_the_figures_are() -> None:
    sweep = compare_runs([stored(episodes("p", 1, "++++"), episodes("p", 4, "----"))], difference=0.2)
    text = render_sweep(sweep, "markdown")
    assert "exact McNemar" in text and "Holm" in text and "a difference of 0.2" in text
    assert "variant" not in text  # there is one only
    line = next(line for line in text.splitlines() if "| p      |  4 " in line)
    assert "-1.00" in line and "0.125" in line  # 2 · 0.5⁴
    assert render_sweep(sweep, "csv").startswith("task,policy,K,episodes,success")


def test_how_the_arm_moved_stands_beside_success_where_a_row_has_it() -> None:
    still, moved = episodes("p", 1, "++"), episodes("p", 4, "+-")
    way = Motion(
        border_jump_m=0.006, border_jump_rad=None, median_step_m=0.004, median_step_rad=None, jerk_m_s3=12.0
    )
    held = [
        replace(one, n_steps=60, n_held_steps=n, motion=way) for one, n in zip(moved, (6, 12), strict=True)
    ]
    sweep = compare_runs([stored(still, held)])
    rows = json.loads(render_sweep(sweep, "json"))["rows"]
    (found,) = (one for one in rows if one["n_action_steps"] == 4)
    assert found["held_share"] == pytest.approx((6 / 60 + 12 / 60) / 2)
    assert found["border_jump"] == pytest.approx(0.006 / 0.004) and found["border_turn_jump"] is None
    head, _, first, second, *notes = render_sweep(sweep, "markdown").splitlines()
    assert head.count("jump") == 1 and "delay" not in head  # no row has a turn, or a delay
    assert "0.15" in second and "1.50" in second and "12.0" in second and "0.15" not in first
    assert [note.partition(":")[0] for note in notes[-2:]] == ["- held", "- jump"]
    assert "jerk" not in render_sweep(compare_runs([stored(still, moved)]), "markdown")


def test_the_verb_prints_the_table_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = EvalConfig(
        name="sweep",
        tasks=(TASK,),
        policies=("oracle", "cue_blind"),
        n_action_steps=(1, 4),
        episodes=3,
        simulator="fake",
        workers=1,
    )
    evaluate(config, out=tmp_path / "run", backend=IN_PROCESS)
    assert main(["compare", str(tmp_path / "run")]) == 0
    out = capsys.readouterr().out
    assert out.count("| oracle ") == 2 and "cue frames" in out


def test_the_shipped_configuration_is_the_papers_question() -> None:
    config = load_recipe("configs", "chunk_sizes", EvalConfig).value
    assert config.n_action_steps == (1, 2, 4, 8, 16)
    assert len(config.tasks) == 5
    assert {"oracle", "cue_blind"} <= set(config.policies)


def test_the_cues_default_length_is_the_simulators() -> None:
    from vla_eval.envs.fake import CHOICE_DEFAULTS
    from vla_eval.results.sweep import DEFAULT_CUE_STEPS

    source = (Path(__file__).parents[2] / "vla_eval/tasks/memory_env.py").read_text()
    assert CHOICE_DEFAULTS["cue_steps"] == DEFAULT_CUE_STEPS
    assert f"cue_steps: StepRange = {DEFAULT_CUE_STEPS}," in source


@pytest.mark.parametrize("width", [60, 80, 140])
def test_on_a_terminal_a_comparison_fits_and_says_what_it_leaves_out(width: int) -> None:
    runs = [stored(episodes("one", 1, "+-+-"), episodes("one", 8, "++--"))]
    text = render_sweep(compare_runs(runs), "markdown", width=width)
    above, table = text.splitlines()[0], [line for line in text.splitlines() if line.startswith("|")]
    assert above.startswith("All rows: task ") and "policy one" in above
    assert max(map(len, table)) <= width
    for title in ("K", "success", "difference", "p (Holm)"):
        assert f" {title} |" in table[0]
    assert ("not shown: " in text) is (width < 140)
