"""What the bench makes of the official runner's times."""

import json
from pathlib import Path

import pytest

from vla_eval.bench.official import (
    Baseline,
    Costs,
    EvaluationRow,
    OfficialReport,
    _official,
    run_official_bench,
)
from vla_eval.errors import ConformanceError


def program(path: Path, script: str) -> Path:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def test_the_ratio_counts_our_start_up_and_theirs_only_where_it_says_so() -> None:
    row = EvaluationRow(
        n_action_steps=8,
        n_steps=1200,
        n_frames=160,
        seconds=10.0,
        first_seconds=4.0,
        cpu_seconds=18.0,
        floor_seconds=5.0,
    )
    baseline = Baseline(name="theirs", n_steps=600, seconds=60.0, cpu_seconds=70.0, start_seconds=20.0)
    report = OfficialReport(
        task="RememberColor3-v0",
        n_workers=2,
        n_episodes=20,
        load=0.0,
        costs=Costs(1.0, 2.0, 3.0),
        baseline=baseline,
        rows=(row,),
    )
    # Theirs: 10 steps/s. Ours: 120. Theirs would need 120 s for 1200 steps, and 20 to start.
    assert report.ratio(row) == pytest.approx(12)
    assert report.ratio_with_both_starts(row) == pytest.approx(14)


def test_the_first_episode_of_the_official_runner_counts_as_its_start(tmp_path: Path) -> None:
    times = {"n_steps": [60, 60, 60], "seconds": [30.0, 36.0, 42.0], "cpu_seconds": [31.0, 38.0, 45.0]}
    python = program(tmp_path / "python", f"echo some warning\necho '{json.dumps(times)}'")
    found = _official("RememberColor3-v0", python, 3, 60)
    assert (found.n_steps, found.seconds, found.cpu_seconds) == (120, 12.0, 14.0)
    assert found.per_second == 10


def test_an_interpreter_that_fails_is_named(tmp_path: Path) -> None:
    broken = program(tmp_path / "broken", "echo no such module >&2; exit 1")
    with pytest.raises(ConformanceError, match="no such module"):
        _official("RememberColor3-v0", broken, 2, 60)


@pytest.mark.slow
def test_a_whole_bench_against_our_own_eager_loop() -> None:
    report = run_official_bench(
        "RememberColor3-v0",
        python=None,
        chunk_lengths=(8,),
        n_workers=2,
        n_episodes=4,
        n_baseline_episodes=2,
    )
    (row,) = report.rows
    assert (row.n_steps, row.n_frames) == (4 * 60, 4 * 8)  # inferences at 0, 8 … 56
    assert report.ratio(row) > 1
    assert 0 < row.first_seconds < row.seconds
    assert row.cpu_seconds > row.n_frames * report.costs.frame_ms / 1000 / 2
