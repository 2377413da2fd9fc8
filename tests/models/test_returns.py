"""Rewards in a batch and returns to go: sums to the end of the episode, and nothing beyond it."""

import pytest
import torch

from vla_eval.models.sequence.modeling_sequence import returns_to_go, rewards_in

SPARSE = {
    "next.reward": torch.tensor([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
    "next.reward_is_pad": torch.tensor([[True, False, False], [False, False, False]]),
}


def test_the_return_to_go_is_the_sum_of_this_reward_and_those_after_it() -> None:
    rewards = torch.tensor([[1.0, 2.0, 4.0], [0.0, 0.0, 1.0]])
    assert returns_to_go(rewards).tolist() == [[7.0, 6.0, 4.0], [1.0, 1.0, 1.0]]


def test_padding_has_no_reward() -> None:
    # Before an episode's beginning lerobot repeats its first row.
    batch = {**SPARSE, "next.reward": torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])}
    assert rewards_in(batch, "sparse").tolist() == [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    assert rewards_in(SPARSE, "sparse")[0].tolist() == [0.0, 1.0, 0.0]


def test_rewards_keep_their_steps_if_each_is_a_row_of_one_number() -> None:
    batch = {**SPARSE, "next.reward": SPARSE["next.reward"][..., None]}
    assert rewards_in(batch, "sparse").tolist() == rewards_in(SPARSE, "sparse").tolist()


def test_dense_rewards_are_refused_where_sparse_ones_were_asked_for() -> None:
    batch = {**SPARSE, "next.reward": SPARSE["next.reward"] / 2}
    with pytest.raises(ValueError, match=r"policy\.reward=dense"):
        rewards_in(batch, "sparse")
    assert rewards_in(batch, "dense").tolist() == [[0.0, 0.5, 0.0], [0.0, 0.5, 0.0]]


def test_a_batch_without_rewards_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"the dataset has no rewards"):
        rewards_in({"next.reward": torch.tensor([0.0])}, "dense")
