"""The instruction in our policies from scratch: which words are in it, and nothing where it is not read."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.sample_frames import at, between, frames
from tests.training.fitted_policies import policy_config
from vla_eval.checkpoints.loading import config_class
from vla_eval.config.files import list_recipes, load_recipe
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.config.prompts import PromptRecipe
from vla_eval.errors import MissingInstructionError, UnknownNameError
from vla_eval.models.episodes.sentence import WORD, SentenceEncoder, word_rows
from vla_eval.models.memory.modeling_memory import MikasaMemoryPolicy
from vla_eval.models.sequence.modeling_sequence import MikasaSequencePolicy
from vla_eval.training.dataset import training_dataset

TINY: dict[str, dict[str, Any]] = {
    "mikasa_memory": {"channels": 4, "heads": 2, "key": 4, "memory": 8, "hidden": 16},
    "mikasa_sequence": {"width": 16, "heads": 2, "context_steps": 20},
}
CLASSES = {"mikasa_memory": MikasaMemoryPolicy, "mikasa_sequence": MikasaSequencePolicy}
BLUE, RED = "pick the blue cube", "pick the red cube"


def tiny_policy(recorded: Path, kind: str, **fields: Any) -> Any:
    torch.manual_seed(0)
    policy = {**TINY[kind], "chunk_size": 3, "n_action_steps": 2, **fields}
    dataset = training_dataset(recorded, allow_unreplayed=True)
    config = policy_config(FinetuneRecipe(type=kind, policy=policy), dataset, device="cpu")
    return CLASSES[kind](config).eval()


def chunk(policy: Any, sentences: list[str], *, n_steps: int = 3) -> torch.Tensor:
    """Return the actions after frames that the policy was shown one by one."""
    seen, memory = {**frames(n_steps, n_episodes=len(sentences))}, None
    for step in range(n_steps):
        memory = policy.remember({**between(seen, step, step + 1), "task": sentences}, memory)
    found: torch.Tensor = policy.predict_action_chunk({**at(seen, n_steps - 1), "task": sentences}, memory)
    return found


@pytest.mark.parametrize("kind", CLASSES)
class TestPolicies:
    def test_one_that_reads_the_sentence_acts_by_it(self, recorded: Path, kind: str) -> None:
        policy = tiny_policy(recorded, kind, sentence="words")
        assert not torch.equal(chunk(policy, [BLUE]), chunk(policy, [RED]))
        both = chunk(policy, [BLUE, RED])
        torch.testing.assert_close(both[:1], chunk(policy, [BLUE, BLUE])[:1])

    def test_one_that_does_not_acts_alike_and_needs_none(self, recorded: Path, kind: str) -> None:
        policy = tiny_policy(recorded, kind)
        assert torch.equal(chunk(policy, [BLUE]), chunk(policy, [RED]))
        assert not any("sentence" in name for name in policy.state_dict())

    def test_all_other_weights_begin_as_without_it(self, recorded: Path, kind: str) -> None:
        without = tiny_policy(recorded, kind).state_dict()
        told = tiny_policy(recorded, kind, sentence="words").state_dict()
        assert all(torch.equal(told[name], value) for name, value in without.items())

    @pytest.mark.parametrize("sentences", [None, [""], ["…"]])
    def test_a_missing_sentence_is_an_error(self, recorded: Path, kind: str, sentences: Any) -> None:
        policy, seen = tiny_policy(recorded, kind, sentence="words"), frames(1)
        with pytest.raises(MissingInstructionError, match="sentence: words"):
            policy.remember({**seen, "task": sentences}, None)

    def test_lerobots_own_loop_gives_it_too(self, recorded: Path, kind: str) -> None:
        policy, seen = tiny_policy(recorded, kind, sentence="words"), frames(1)
        policy.reset()
        torch.testing.assert_close(
            policy.select_action({**at(seen, 0), "task": [RED]}), chunk(policy, [RED], n_steps=1)[:, 0]
        )

    def test_its_words_learn(self, recorded: Path, kind: str) -> None:
        policy = tiny_policy(recorded, kind, sentence="words").train()
        n_steps = policy.config.n_window_steps
        batch: dict[str, Any] = frames(n_steps + 1, n_episodes=2)
        batch["action"] = torch.rand(2, n_steps + 2, 7, generator=torch.Generator().manual_seed(2))
        batch["action_is_pad"] = torch.zeros(2, n_steps + 2, dtype=torch.bool)
        batch["observation.state_is_pad"] = torch.zeros(2, n_steps + 1, dtype=torch.bool)
        batch["task"] = [BLUE, RED]
        policy.forward(batch)[0].backward()
        gradient = policy.network.sentence.words.weight.grad
        learned = set(gradient.abs().sum(dim=1).nonzero().flatten().tolist())
        assert learned == {*word_rows(BLUE), *word_rows(RED)}

    def test_another_word_for_it_is_refused(self, recorded: Path, kind: str) -> None:
        with pytest.raises(UnknownNameError, match=r"'word'.*Did you mean 'words'"):
            config_class(kind, where="test")(sentence="word")


def test_capitals_and_commas_do_not_matter_and_other_words_do() -> None:
    torch.manual_seed(0)
    encoder = SentenceEncoder(5)
    same, alike, other = encoder(["Touch it, again", "touch it again", "touch it once"])
    torch.testing.assert_close(same, alike)
    assert not torch.allclose(same, other)


def test_what_is_said_in_a_batch_is_what_is_said_alone() -> None:
    torch.manual_seed(0)
    encoder = SentenceEncoder(5)
    sentences = ["one", "two words", "three words here"]
    alone = torch.cat([encoder([sentence]) for sentence in sentences])
    torch.testing.assert_close(encoder(sentences), alone)


def test_a_row_is_the_digest_of_a_word() -> None:
    assert word_rows("A a") == [0xE8B7BE43 % 4096] * 2  # crc32 of "a", https://reveng.sourceforge.io


def test_no_two_words_of_the_shipped_sentences_share_a_row() -> None:
    words = set()
    for name in list_recipes("prompts"):
        for sentences in load_recipe("prompts", name, PromptRecipe).value.instructions.values():
            words |= {word for sentence in sentences for word in WORD.findall(sentence.lower())}
    rows = {word: word_rows(word)[0] for word in words}
    assert len(words) > 50
    assert len(set(rows.values())) == len(words)
