"""Which rewards a training reads of a dataset."""

from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.data.frames.decoded_frames import DecodedFramesDataset, rewards_of
from vla_eval.errors import DatasetError

# Two episodes of 4 and 3 frames; in the first, success holds from its third frame on.
BOUNDS = torch.tensor([[0, 4]] * 4 + [[4, 7]] * 3)
COLUMNS = {
    "next.success": torch.tensor([False, False, True, True, False, True, False]),
    "next.reward": torch.tensor([0.1, 0.2, 1.0, 1.0, 0.3, 1.0, 0.5]),
}


def test_sparse_is_one_at_each_episodes_first_success() -> None:
    assert rewards_of(COLUMNS, BOUNDS, "sparse", root=Path("d")).tolist() == [0, 0, 1, 0, 0, 1, 0]


def test_success_is_one_wherever_the_rule_holds() -> None:
    assert rewards_of(COLUMNS, BOUNDS, "success", root=Path("d")).tolist() == [0, 0, 1, 1, 0, 1, 0]


def test_an_episode_without_success_has_no_sparse_reward() -> None:
    columns = {"next.success": torch.zeros(7, dtype=torch.bool)}
    assert rewards_of(columns, BOUNDS, "sparse", root=Path("d")).tolist() == [0] * 7


def test_dense_is_the_tables() -> None:
    assert torch.equal(rewards_of(COLUMNS, BOUNDS, "dense", root=Path("d")), COLUMNS["next.reward"])


def test_a_dataset_without_successes_says_what_is_missing() -> None:
    with pytest.raises(DatasetError, match=r"d: has no field 'next\.success', which `reward: sparse`"):
        rewards_of({"next.reward": torch.zeros(7)}, BOUNDS, "sparse", root=Path("d"))


def test_samples_hold_the_rewards_that_were_asked_for(recorded: Path, tmp_path: Path) -> None:
    """Four episodes of 13, 14, 15 and 13 frames, each solved in its last one."""
    window = {"next.reward": [(step - 12) / 20 for step in range(13)]}
    source = LeRobotDataset("local/recorded", root=recorded, delta_timestamps=window)
    served = {
        kind: DecodedFramesDataset(source, cache=tmp_path, whole_episodes=True, reward=kind)
        for kind in (None, "dense", "sparse")
    }
    assert served["sparse"][3]["next.reward"].tolist() == [0.0] * 12 + [1.0]
    assert torch.equal(served["dense"][3]["next.reward"], served[None][3]["next.reward"])
    assert not served["sparse"][3]["next.reward_is_pad"].any()
