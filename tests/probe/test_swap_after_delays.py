"""Pairs of worlds after each delay: who always does the same is right by luck, and never warranted."""

from pathlib import Path
from typing import Any

import pytest

from tests.probe.test_probe import TASK_CONFIG, probe, rows_of
from tests.probe.test_quantities import record
from vla_eval.probe.interventions import plan_probe
from vla_eval.probe.table import probe_table
from vla_eval.probe.worlds import ProbeSettings
from vla_eval.records import EpisodeRecord

pytestmark = pytest.mark.usefixtures("in_this_process")
N_SEEDS = 12


def test_each_delay_has_a_pair_of_worlds() -> None:
    probe = plan_probe(TASK_CONFIG, ProbeSettings(probes=("delay_swap",), delays=(5, 80), swaps=(2, 1)))
    found = {(world.intervention, world.level): world.config.env for world in probe.worlds}
    assert found == {
        ("none", None): {"delay_steps": 5},
        ("swap", 2): {"delay_steps": 5, "swap_cue": 2},
        ("delay", 80): {"delay_steps": 80, "horizon_steps": 135},
        ("delay_swap", 80): {"delay_steps": 80, "horizon_steps": 135, "swap_cue": 2},
    }
    both = plan_probe(
        TASK_CONFIG, ProbeSettings(probes=("swap", "delay", "delay_swap"), delays=(80,), swaps=(2, 1))
    )
    names = [world.config.name for world in both.worlds]
    assert len(names) == len(set(names)) == 5  # and the other swap


def choosing(choice: int | None, target: int) -> list[EpisodeRecord]:
    return [record(seed, target=target, choice=choice) for seed in range(N_SEEDS)]


def test_what_is_retained_is_choice_by_the_cue_and_not_luck_in_one_world() -> None:
    """After 80 steps the policy goes to candidate 0, which is right as drawn and wrong after the swap."""
    worlds = plan_probe(TASK_CONFIG, ProbeSettings(probes=("delay_swap",), delays=(80,))).worlds
    choices = {
        ("none", None): choosing(0, target=0),
        ("swap", 1): choosing(1, target=1),
        ("delay", 80): choosing(0, target=0),
        ("delay_swap", 80): choosing(0, target=1),
    }
    table = probe_table(worlds, [choices[world.intervention, world.level] for world in worlds])
    curves = {curve.of: curve for curve in table.retention}

    assert [(point.delay_steps, point.share) for point in curves["follows"].points] == [
        *((5, (N_SEEDS, N_SEEDS)), (80, (N_SEEDS, N_SEEDS)))
    ]
    assert [(point.delay_steps, point.share) for point in curves["warranted_choice"].points] == [
        *((5, (N_SEEDS, N_SEEDS)), (80, (0, N_SEEDS)))
    ]
    assert curves["warranted_choice"].points[0].chance == pytest.approx(1 / 9)
    assert curves["follows"].half_life is not None and curves["follows"].half_life.steps is None
    half = curves["warranted_choice"].half_life
    # From 1 to 0 between 5 and 80; the middle of 1 and 1/9 is 5/9.
    assert half is not None and half.steps == pytest.approx(5 + 75 * (4 / 9))
    (swapped,) = [row for row in table.rows if row.intervention == "delay_swap"]
    assert swapped.swap is not None
    assert (swapped.n_pairs, swapped.swap.sensitivity) == (N_SEEDS, (0, N_SEEDS))


def test_without_a_swapped_delay_there_is_one_curve_as_before() -> None:
    worlds = plan_probe(TASK_CONFIG, ProbeSettings(probes=("swap", "delay"), delays=(80,))).worlds
    table = probe_table(worlds, [choosing(0, target=0) for _ in worlds])
    assert [curve.of for curve in table.retention] == ["follows"]


def test_an_oracle_follows_both_cues_after_each_delay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--task", "RememberColor3-v0", "--policy", "oracle", "--no-controls")
    found: dict[str, Any] = probe(tmp_path, capsys, *arguments, "--probe", "delay_swap", "--delay", "0", "12")
    assert rows_of(found, "delay_swap")["oracle"]["warranted_choice"] == 1.0
    warranted = {curve["of"]: curve for curve in found["retention"]}["warranted_choice"]
    assert [point["n_warranted_choice"] for point in warranted["points"]] == [9, 9, 9]
    assert [point["delay_steps"] for point in warranted["points"]] == [0, 5, 12]
    assert "follows the cue in both worlds after a delay of 12 steps in 9 of 9 pairs" in found["sentences"][0]
    assert "half-life of following it in both worlds more than 12 steps" in found["sentences"][0]
