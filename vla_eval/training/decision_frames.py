"""Where the arm of a dataset's demonstrations begins to move after it waited: what some policies weigh."""

from itertools import pairwise
from typing import Any  # lerobot is untyped

import numpy as np
import torch

from vla_eval.data.tables import read_columns
from vla_eval.features import ACTION_KEY
from vla_eval.models.episodes.samples import decisions
from vla_eval.training.dataset import TrainingDataset

EPISODE_INDEX = "episode_index"


def n_with_decisions(dataset: TrainingDataset) -> int:
    """Return in how many of the episodes that are trained on the arm begins to move after it waited."""
    columns = read_columns(dataset.root, (EPISODE_INDEX, ACTION_KEY))
    episodes = columns[EPISODE_INDEX]
    bounds = [0, *(np.flatnonzero(episodes[1:] != episodes[:-1]) + 1).tolist(), len(episodes)]
    actions = torch.from_numpy(columns[ACTION_KEY].astype(np.float32))
    left_out = set(dataset.left_out)
    return sum(
        bool(decisions(actions[first:stop]).any())
        for first, stop in pairwise(bounds)
        if int(episodes[first]) not in left_out
    )


def about_decisions(dataset: TrainingDataset, policy: Any) -> str | None:
    """Return a line for a person; None for a policy that does not weigh decisions.

    Args:
        dataset: to train on.
        policy: its LeRobot configuration.
    """
    share = getattr(policy, "decision_share", 0.0)
    if not share:
        return None
    n_found = n_with_decisions(dataset)
    n_episodes = dataset.meta.total_episodes - len(dataset.left_out)
    if n_found:
        return f"decisions: in {n_found} of {n_episodes} episodes the arm begins to move after it waited"
    return (
        f"warning: policy.decision_share is {share:g}, and in none of {n_episodes} episodes does the arm "
        "begin to move after it waited: samples are whole episodes, and nothing in them asks for memory "
        "alone. If the task makes the arm wait, its noise is in the recorded actions: record with "
        "--set stored_action=intended."
    )
