"""The command on the simulated arm: with faults, killed, resumed; and the table that it prints."""

import dataclasses
import json
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.cli.every_verb import command_line, environment_of
from tests.real.test_session import evaluation, session
from vla_eval.config.real_robot import SIMULATED
from vla_eval.envs.robot.opening import open_robot
from vla_eval.real.table import p_below, paper_row, real_table, stage_rows
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.real_stages import STAGES, stage_of

REAL = "real --robot simulated_so100 --operator scripted --policy oracle --episodes 2 --paper --out {W}/run"
N_EPISODES = 2 * 3 * 3  # per colour, colours, stages


def records_of(folder: Path) -> list[EpisodeRecord]:
    return sorted(read_run(folder).records, key=lambda one: (one.task, one.seed))


@pytest.mark.slow
def test_it_runs_with_faults_is_killed_resumed_and_prints_the_papers_table(tmp_path: Path) -> None:
    faulty = command_line(f"{REAL} --rehearse cable@2 camera@3 power@4 key@6 away@7", tmp_path)
    log = (tmp_path / "said").open("w")
    environment = environment_of(tmp_path)
    episodes = tmp_path / "run" / "episodes.jsonl"
    with subprocess.Popen(
        faulty, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
    ) as process:
        while not episodes.exists() or episodes.read_bytes().count(b"\n") < 10:
            assert process.poll() is None, (tmp_path / "said").read_text()
            time.sleep(0.1)
        os.kill(process.pid, signal.SIGKILL)
    stored = Counter(json.loads(line)["outcome"] for line in episodes.read_bytes().splitlines()[:10])
    assert stored == {"success": 5, "error": 5}

    resumed = subprocess.run(
        command_line(REAL, tmp_path),
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    printed = resumed.stdout
    for line in ("oracle", "π0.5 (paper)", "0.63 [0.46, 0.78]", "chance (p = 0.003"):
        assert line in printed
    found = records_of(tmp_path / "run")
    assert len(found) == N_EPISODES and all(one.outcome != "error" for one in found)

    # As if nothing had happened; cameras, which this policy does not read, change nothing.
    blind = dataclasses.replace(SIMULATED, lerobot={**SIMULATED.lerobot, "views": []})
    asked = evaluation(tmp_path / "whole", settings=blind, stages=STAGES, episodes=2)
    arm = open_robot(blind)
    session(arm, asked).run(command="")
    arm.close()
    assert records_of(tmp_path / "whole") == found


def record(stage: str, seed: int, *, touched: Sequence[int] = (), picked: bool = False) -> EpisodeRecord:
    """An episode whose right cube has the index `seed % 3`."""
    target = seed % 3
    return EpisodeRecord(
        task=stage_of(stage).real_id,
        policy="mine",
        n_action_steps=1,
        run=0,
        seed=seed,
        outcome="success" if picked else "failure",
        success_once=picked,
        n_steps=9,
        target=target,
        n_candidates=3,
        touched_candidates=tuple(touched),
        first_choice=touched[0] if touched else None,
        first_choice_success=bool(touched) and touched[0] == target,
    )


def test_touched_is_the_right_cube_at_any_time_and_errors_are_in_no_rate() -> None:
    broken = EpisodeRecord(
        task=stage_of("CubeVisible").real_id,
        policy="mine",
        n_action_steps=1,
        run=0,
        seed=8,
        outcome="error",
        error=EpisodeError(kind="RobotBusError", stage="step", message="m"),
    )
    episodes = [
        record("CubeVisible", 0, touched=(1, 0), picked=True),  # a wrong one first, then the right one
        record("CubeVisible", 1, touched=(2,)),
        record("CubeVisible", 2),
        record("CubeVisible", 3, touched=(0,)),
        broken,
    ]
    (row,) = stage_rows(episodes)
    assert (row.n_episodes, row.n_errors) == (4, 1)
    assert (row.touched, row.picked) == ((2, 4), (1, 4))
    assert row.by_color == ((1.0, 0.5), (0.0, 0.0), (0.0, 0.0))


def test_the_papers_rows_are_beside_and_say_what_is_below_chance() -> None:
    table = real_table([record("CubesShuffled", 0), record("CubeVisible", 0)], with_paper=True)
    assert [row[:3] for row in table.rows] == [
        ["CubeVisible", "mine", "1"],
        ["CubeVisible", "π0.5 (paper)", "30"],
        ["CubesShuffled", "mine", "1"],
        ["CubesShuffled", "π0.5 (paper)", "30"],
    ]
    below = [note for note in table.notes if "below chance" in note]
    assert len(below) == 1 and "3 of 30 touched" in below[0] and "p = 0.003" in below[0]
    assert not any("paper" in note for note in real_table([record("CubeVisible", 0)], with_paper=False).notes)


@pytest.mark.parametrize(("n", "p"), [(0, (2 / 3) ** 4), (3, 1 - (1 / 3) ** 4), (4, 1.0)])
def test_the_probability_of_at_most_so_many_is_that_of_the_binomial_distribution(n: int, p: float) -> None:
    touched = paper_row(STAGES[0]).touched._replace(n=n, of=4)
    assert p_below(touched) == pytest.approx(p)
