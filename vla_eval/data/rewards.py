"""The rewards that a training reads of a dataset: those of the table, or success alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any  # columns are tensors, or lists of texts

from torch import Tensor

from vla_eval.errors import DatasetError
from vla_eval.features import REWARD_KEY, SUCCESS_KEY, RewardKind


def rewards_of(columns: Mapping[str, Any], bounds: Tensor, kind: RewardKind, *, root: Path) -> Tensor:
    """Return the reward of each row, (N,) float32.

    Args:
        columns: field -> (N, …).
        bounds: (N, 2) first and stop row of each row's episode.
        kind: `dense`: the table's; `sparse`: 1 where the success rule holds for the first time in the
            episode, else 0, so that the sum over an episode is whether it succeeded once; `success`: 1
            wherever it holds.
        root: the dataset's folder, for messages.

    Raises:
        DatasetError: the dataset does not say what its rewards or successes are.
    """
    key = REWARD_KEY if kind == "dense" else SUCCESS_KEY
    if key not in columns:
        raise DatasetError(
            f"{root}: has no field '{key}', which `reward: {kind}` is read from. Use a dataset with rewards "
            "(`mikasa-vla record` stores them), or a policy that reads none."
        )
    values: Tensor = columns[key].reshape(-1).float()
    if kind != "sparse":
        return values
    n_so_far = values.cumsum(0)
    n_before_episode = n_so_far[bounds[:, 0]] - values[bounds[:, 0]]
    return values * (n_so_far - n_before_episode == 1)
