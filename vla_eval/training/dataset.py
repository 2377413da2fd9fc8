"""What a fine-tuning asks of a dataset, and which of its episodes it learns from."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
import torch

from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.control_modes import CONTROL_MODES, MOTORS
from vla_eval.data.check import require_checked
from vla_eval.data.facts import DatasetFacts, MixtureFacts
from vla_eval.data.info_file import one_dataset
from vla_eval.data.opening import OpenDataset, open_dataset
from vla_eval.errors import DatasetError
from vla_eval.features import ACTION_KEY
from vla_eval.models.episodes.samples import decisions


def training_dataset(root: Path, *, allow_unreplayed: bool) -> OpenDataset:
    """Return a folder's dataset if it is complete and replayed without a mismatch, unless that is waived."""
    dataset = open_dataset(one_dataset(root))
    root, control_mode = dataset.root, dataset.facts.control_mode
    of_an_arm = control_mode == MOTORS  # which nothing replays: an operator has marked its successes
    if not dataset.was_replayed and not allow_unreplayed and not of_an_arm:
        raise DatasetError(
            f"{root}: no replay has confirmed this dataset: it is not known whether its actions lead to what "
            f"its images show. {_to_replay(dataset)}; or train on it all the same with --allow-unreplayed, "
            f"which is noted in the run."
        )
    if control_mode not in CONTROL_MODES and not of_an_arm:
        raise DatasetError(
            f"{root}: its actions are for '{control_mode}', which the environments here do not execute (they "
            f"take {', '.join(CONTROL_MODES)}). A policy that is trained on it could not be evaluated."
        )
    require_checked(dataset)
    missing = [key for key in dataset.cameras if key not in dataset.meta.features]
    if not dataset.cameras:
        raise DatasetError(f"{root}: expected images, found none: policies here see through cameras.")
    if missing:
        raise DatasetError(f"{root}: expected the images {', '.join(missing)}, found none of that name.")
    return dataset


def _to_replay(dataset: OpenDataset) -> str:
    if isinstance(dataset.facts, DatasetFacts):
        return f"Run mikasa-vla replay {dataset.root}"
    if isinstance(dataset.facts, MixtureFacts):
        names = ", ".join(source.name for source in dataset.facts.sources if not source.was_replayed)
        return f"Its sources {names} had not been replayed: replay these and mix again"
    return "It was imported and cannot be replayed"


def chosen_episodes(dataset: OpenDataset, recipe: FinetuneRecipe, policy: Any) -> OpenDataset:
    """Return the dataset without failed episodes, unless they are to be kept or the policy reads rewards."""
    reads_rewards = getattr(policy, "reward", None) is not None
    keeps = recipe.failed_episodes == "keep" or (recipe.failed_episodes is None and reads_rewards)
    if keeps or not dataset.failed:
        return dataset
    if len(dataset.failed) == dataset.meta.total_episodes:
        raise DatasetError(
            f"{dataset.root}: expected episodes to imitate, found none in which the success rule ever held "
            f"(of {dataset.meta.total_episodes}). Record others, or set finetune.failed_episodes to keep."
        )
    return replace(dataset, left_out=dataset.failed)


def about_failures(dataset: OpenDataset) -> str:
    """Return a line for a person: what is done with the failed episodes."""
    done = "left out" if dataset.left_out else "kept"
    return f"failed episodes: {len(dataset.failed)} of {dataset.meta.total_episodes}, {done}"


def n_with_decisions(actions: np.ndarray[Any, Any], lengths: Sequence[int]) -> int:
    """Return in how many episodes the arm begins to move after it waited; actions are (N, A)."""
    bounds = pairwise(np.cumsum([0, *lengths]).tolist())
    rows = torch.from_numpy(actions.astype(np.float32))
    return sum(bool(decisions(rows[first:stop]).any()) for first, stop in bounds)


def about_decisions(dataset: OpenDataset, policy: Any) -> str | None:
    """Return a line for a person; None for a policy that does not weigh decisions."""
    share = getattr(policy, "decision_share", 0.0)
    if not share:
        return None
    n_found = n_with_decisions(dataset.columns_used[ACTION_KEY], dataset.lengths)
    n_episodes = len(dataset.lengths)
    if n_found:
        return f"decisions: in {n_found} of {n_episodes} episodes the arm begins to move after it waited"
    return (
        f"warning: policy.decision_share is {share:g}, and in none of {n_episodes} episodes does the arm "
        "begin to move after it waited: samples are whole episodes, and nothing in them asks for memory "
        "alone. If the task makes the arm wait, its noise is in the recorded actions: record with "
        "--set stored_action=intended."
    )
