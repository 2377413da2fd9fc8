"""Decisions in a dataset: where an arm begins to move after it waited."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from vla_eval.training.decision_frames import about_decisions, n_with_decisions

WAITS_THEN_MOVES = [0.0, 0.0, 0.0, 0.5, 0.9]
MOVES_AT_ONCE = [0.1, 0.2, 0.3]
NOISY = [0.01, -0.02, 0.015, 0.5, 0.47]  # the same motion, with noise in what is recorded
WEIGHS, DOES_NOT = SimpleNamespace(decision_share=0.7), SimpleNamespace()


def dataset(root: Path, *episodes: list[float], left_out: tuple[int, ...] = ()) -> Any:
    rows = [(index, [value, 0.0]) for index, values in enumerate(episodes) for value in values]
    (root / "data/chunk-000").mkdir(parents=True)
    table = pa.table({"episode_index": [row[0] for row in rows], "action": [row[1] for row in rows]})
    pq.write_table(table, root / "data/chunk-000/file-000.parquet")
    meta = SimpleNamespace(total_episodes=len(episodes))
    return SimpleNamespace(root=root, meta=meta, left_out=left_out)


def test_an_episode_counts_if_its_arm_moves_after_waiting(tmp_path: Path) -> None:
    assert n_with_decisions(dataset(tmp_path, WAITS_THEN_MOVES, MOVES_AT_ONCE, WAITS_THEN_MOVES)) == 2


def test_episodes_that_are_left_out_of_training_do_not_count(tmp_path: Path) -> None:
    three = dataset(tmp_path, WAITS_THEN_MOVES, WAITS_THEN_MOVES, MOVES_AT_ONCE, left_out=(0,))
    told = about_decisions(three, WEIGHS)
    assert told == "decisions: in 1 of 2 episodes the arm begins to move after it waited"


def test_a_policy_that_weighs_decisions_is_told_when_noise_hides_them(tmp_path: Path) -> None:
    hidden = dataset(tmp_path / "noisy", NOISY, NOISY)
    told = about_decisions(hidden, WEIGHS)
    assert told is not None and told.startswith("warning: policy.decision_share is 0.7, and in none of 2")
    assert "stored_action=intended" in told
    assert about_decisions(hidden, DOES_NOT) is None
    clear = dataset(tmp_path / "clear", WAITS_THEN_MOVES, MOVES_AT_ONCE)
    assert about_decisions(clear, WEIGHS) == (
        "decisions: in 1 of 2 episodes the arm begins to move after it waited"
    )
