"""Actions as tokens: bins, decoding all at once as the original, and one after the other."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from torch.nn import functional

from tests.models.openvla import openvla_golden as golden
from vla_eval.models.openvla.generation import (
    from_tokens,
    generated_actions,
    parallel_actions,
    to_tokens,
    token_loss,
)
from vla_eval.models.openvla.network import Inputs, OpenVLANetwork
from vla_eval.models.openvla.sizes import NetworkOptions
from vla_eval.models.shared.greedy import Prompts

TEXT = golden.SIZES.text_vocabulary
SMALL = dataclasses.replace(
    golden.SIZES, image_px=28, vocabulary=320, text_vocabulary=300, pad_token=301, empty_token=3
)
ROWS = [[1, 512, 29901, 29871], [1, 512, 29901, 1724, 3158, 881, 29871]]


@functools.cache
def made(head: str, chunk: int = golden.CHUNK) -> OpenVLANetwork:
    return golden.network(head=head, chunk=chunk)


def test_bins_are_those_of_numpys_digitize() -> None:
    actions = np.concatenate([np.linspace(-1.2, 1.2, 1001), [-1.0, 1.0, 0.0]])
    expected = TEXT - np.digitize(actions.clip(-1, 1), np.linspace(-1, 1, 256))
    assert to_tokens(torch.from_numpy(actions), TEXT).tolist() == expected.tolist()


def test_an_action_comes_back_within_half_a_bin_and_the_outermost_tokens_are_the_outermost_bins() -> None:
    actions = torch.linspace(-1, 1, 777)
    back = from_tokens(to_tokens(actions, TEXT), TEXT)
    assert float((back - actions).abs().max()) <= 1 / 255 + 1e-6  # a bin is 2 / 255 wide
    # Token 31999 is bin 1, around -1 + 1 / 255; 31744 is the value 1 alone; 5 is a word.
    told = from_tokens(torch.tensor([31999, 31745, 31744, 5]), TEXT)
    torch.testing.assert_close(told, torch.tensor([-1 + 1 / 255, 1 - 1 / 255, 1 - 1 / 255, 1 - 1 / 255]))


def test_decoding_all_at_once_is_the_originals() -> None:
    network, values = made("parallel_tokens"), golden.values()
    inputs = Inputs(golden.images(2)[:1], golden.prompts("prompt1"))
    with torch.no_grad():
        hidden, told = network.action_states(network.sequence(inputs)), parallel_actions(network, inputs)
    for found, name in ((hidden, "hidden"), (told[0], "actions_normalized")):
        expected = values[f"infer.img2.prompt1.discrete.{name}"]
        torch.testing.assert_close(found, expected, atol=golden.TOLERANCE, rtol=0)


def test_the_loss_of_tokens_all_at_once_is_the_originals_with_the_stop_token() -> None:
    network, chunk = made("parallel_tokens"), golden.values()["train.actions"]
    inputs = Inputs(golden.images(2), golden.training_prompts())
    with torch.no_grad():
        loss = token_loss(network, inputs, chunk, torch.ones(chunk.shape[:2]))
        sequence = network.sequence(inputs)
        logits = network.llm.lm_head(network.hidden(sequence))
    # The original labels all that follows a prompt, the stop token included, and transformers predicts each
    # label one position before it; the rest is left out (-100).
    tokens = TEXT - np.digitize(chunk.flatten(1).numpy().clip(-1, 1), np.linspace(-1, 1, 256))
    labels = torch.full(logits.shape[:2], -100)
    for row, (first, answer) in enumerate(zip(sequence.first_action, tokens, strict=True)):
        labels[row, first : first + len(answer) + 1] = torch.tensor([*answer, golden.SIZES.stop_token])
    n_labels = golden.CHUNK * golden.ACTION + 1  # and stop
    assert (labels != -100).sum(dim=1).tolist() == [n_labels] * len(chunk)
    expected = functional.cross_entropy(logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten())
    torch.testing.assert_close(loss, expected)


class TestOneAfterTheOther:
    @pytest.fixture
    def network(self) -> OpenVLANetwork:
        return made("tokens", 1)

    def test_each_token_is_what_a_pass_without_a_cache_tells(self, network: OpenVLANetwork) -> None:
        inputs = Inputs(golden.images(1)[:1], golden.padded([ROWS[1]]))
        ids = torch.zeros(1, 7, dtype=torch.long)
        with torch.no_grad():
            for place in range(7):
                hidden = network.action_states(network.sequence(inputs, ids), causal=True)
                ids[:, place] = network.llm.lm_head(hidden[:, place]).argmax(dim=-1)
            told = generated_actions(network, inputs)
        assert len(set(ids[0].tolist())) > 1
        assert torch.equal(told[0, 0], from_tokens(ids[0], TEXT))

    def test_prompts_of_several_lengths_get_together_what_they_get_alone(
        self, network: OpenVLANetwork
    ) -> None:
        images = golden.images(1)
        with torch.no_grad():
            together = generated_actions(network, Inputs(images, golden.padded(ROWS)))
            for index, row in enumerate(ROWS):
                one = Inputs(images[index : index + 1], golden.padded([row]))
                alone = generated_actions(network, one)
                assert torch.equal(together[index], alone[0])

    def test_training_lowers_the_loss_until_the_actions_are_told(self) -> None:
        torch.manual_seed(0)
        network = OpenVLANetwork(SMALL, NetworkOptions(head="tokens", chunk=1))
        wanted = torch.tensor([[[0.5, -0.5, 0.1, 0.9, -0.9, 0.0, 1.0]]])
        prompts = Prompts(torch.tensor([[1, 9, 3]]), torch.ones(1, 3, dtype=torch.bool))
        inputs = Inputs(golden.images(1)[:1, ..., :28, :28], prompts)
        optimizer = torch.optim.Adam(network.parameters(), 1e-2)
        for _ in range(30):
            loss = token_loss(network, inputs, wanted, torch.ones(1, 1))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            told = generated_actions(network, inputs)
        assert float((told - wanted).abs().max()) <= 1 / 255 + 1e-6

    def test_the_loss_is_the_cross_entropy_of_seven_tokens_and_stop(self, network: OpenVLANetwork) -> None:
        action, inputs = torch.zeros(1, 1, 7), Inputs(golden.images(1)[:1], golden.padded([ROWS[0]]))
        with torch.no_grad():
            loss = token_loss(network, inputs, action, torch.ones(1, 1))
            ids = torch.full((1, 7), TEXT - 128)  # 0 is in the middle of bin 128 of 255
            embeddings = network.sequence(inputs, ids)
            logits = network.llm.lm_head(network.hidden(embeddings, causal=True))[0]
        n = logits.shape[0] - 1  # positions: … prompt, 7 tokens, stop
        expected = functional.cross_entropy(logits[n - 8 : n], torch.tensor([*ids[0], 2]))
        torch.testing.assert_close(loss, expected)
