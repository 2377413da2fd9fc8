"""Decisions in a dataset: where an arm begins to move after it waited."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from vla_eval.data.opening import OpenDataset
from vla_eval.training.dataset import about_decisions, n_with_decisions

WAITS_THEN_MOVES = [0.0, 0.0, 0.0, 0.5, 0.9]
MOVES_AT_ONCE = [0.1, 0.2, 0.3]
NOISY = [0.01, -0.02, 0.015, 0.5, 0.47]  # the same motion, with noise in what is recorded
WEIGHS, DOES_NOT = SimpleNamespace(decision_share=0.7), SimpleNamespace()


def dataset(*episodes: list[float], left_out: tuple[int, ...] = ()) -> Any:
    """Return an open dataset as far as its actions go."""
    rows = [(index, [value, 0.0]) for index, values in enumerate(episodes) for value in values]
    columns = {
        "episode_index": np.array([row[0] for row in rows]),
        "action": np.array([row[1] for row in rows]),
    }
    local = SimpleNamespace(lengths=[len(values) for values in episodes], columns=columns)
    of: Any = {"facts": None, "manifest": (), "failed_seeds": (), "replay": None}
    return OpenDataset(root=Path(), local=local, left_out=left_out, **of)


def test_an_episode_counts_if_its_arm_moves_after_waiting() -> None:
    three = dataset(WAITS_THEN_MOVES, MOVES_AT_ONCE, WAITS_THEN_MOVES)
    assert n_with_decisions(three.columns["action"], three.lengths) == 2


def test_episodes_that_are_left_out_of_training_do_not_count() -> None:
    three = dataset(WAITS_THEN_MOVES, WAITS_THEN_MOVES, MOVES_AT_ONCE, left_out=(0,))
    told = about_decisions(three, WEIGHS)
    assert told == "decisions: in 1 of 2 episodes the arm begins to move after it waited"


def test_a_policy_that_weighs_decisions_is_told_when_noise_hides_them() -> None:
    hidden = dataset(NOISY, NOISY)
    told = about_decisions(hidden, WEIGHS)
    assert told is not None and told.startswith("warning: policy.decision_share is 0.7, and in none of 2")
    assert "stored_action=intended" in told
    assert about_decisions(hidden, DOES_NOT) is None
    clear = dataset(WAITS_THEN_MOVES, MOVES_AT_ONCE)
    assert about_decisions(clear, WEIGHS) == (
        "decisions: in 1 of 2 episodes the arm begins to move after it waited"
    )
