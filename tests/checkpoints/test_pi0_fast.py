"""π0-FAST: its action tokens are read as data, its chunks are whole, and a tiny one goes the whole way."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers import AutoTokenizer

from tests.training import tiny_trainings
from tests.training.test_finetune import KilledAt, run_an_episode, weights
from tests.training.tiny_trainings import SHORT, context
from vla_eval.checkpoints.fast_tokens import FastActionTokenizer, load_fast_tokenizer
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import CheckpointError
from vla_eval.testing.tiny_models import (
    TINY_POLICY,
    VOCABULARY,
    make_tiny,
    tiny_paligemma,
    write_tiny_fast_tokenizer,
)
from vla_eval.training.finetune import finetune

tokenizer = tiny_trainings.tokenizer
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own

CHUNK = 4
TINY_FAST = {
    "chunk_size": CHUNK,
    "n_action_steps": CHUNK,
    "image_resolution": [56, 56],
    "dtype": "float32",
    "tokenizer_max_length": 64,
    "max_action_tokens": 48,
    "max_decoding_steps": 6,
    "validate_action_token_prefix": False,  # random weights begin with anything
    "scheduler_decay_steps": 4,
}


@pytest.fixture
def fast(tmp_path: Path) -> FastActionTokenizer:
    return load_fast_tokenizer(str(write_tiny_fast_tokenizer(tmp_path / "fast")))


class TestTokens:
    def test_a_constant_is_its_first_coefficient(self, fast: FastActionTokenizer) -> None:
        # An orthonormal cosine transform of T equal values v: v * sqrt(T), then nothing.
        (ids,) = fast(np.full((1, 4, 2), 0.5))
        characters = [ord(character) + fast.min_token for character in fast.bpe_tokenizer.decode(ids)]
        assert characters == [10, 10, 0, 0, 0, 0, 0, 0]  # 0.5 * 2 * scale 10, both numbers of a step in turn

    def test_what_lies_below_the_alphabet_is_its_lowest_character(self, fast: FastActionTokenizer) -> None:
        (ids,) = fast(np.full((1, 4, 1), -4.0))  # -4 * 2 * 10 = -80
        assert ord(fast.bpe_tokenizer.decode(ids)[0]) + fast.min_token == fast.min_token == -60

    def test_its_vocabulary_may_lie_in_a_folder_of_its_own(
        self, fast: FastActionTokenizer, tmp_path: Path
    ) -> None:
        folder = write_tiny_fast_tokenizer(tmp_path / "published")
        below = folder / "bpe_tokenizer"
        below.mkdir()
        for file in folder.glob("tokenizer*"):
            file.rename(below / file.name)
        actions = np.linspace(-1, 1, 24).reshape(1, 8, 3)
        assert load_fast_tokenizer(str(folder))(actions) == fast(actions)

    def test_another_scheme_is_refused(self, tmp_path: Path) -> None:
        folder = write_tiny_fast_tokenizer(tmp_path / "fast")
        file = folder / "processor_config.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "processor_class": "ResidualFAST"}))
        with pytest.raises(
            CheckpointError, match=r"is a 'ResidualFAST'; expected a 'UniversalActionProcessor'"
        ):
            load_fast_tokenizer(str(folder))

    def test_a_missing_one_says_how_to_name_it(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match=r"cannot be read.*policy\.action_tokenizer_name"):
            load_fast_tokenizer(str(tmp_path / "nothing"))


def test_code_that_comes_with_a_tokenizer_is_not_run(tmp_path: Path) -> None:
    trace, folder = tmp_path / "it-ran", tmp_path / "foreign"
    folder.mkdir()
    (folder / "theirs.py").write_text(
        f"open({str(trace)!r}, 'w').close()\n"
        "from transformers import PreTrainedTokenizerFast\n"
        "class Theirs(PreTrainedTokenizerFast): ...\n"
    )
    settings = {"tokenizer_class": "Theirs", "auto_map": {"AutoTokenizer": [None, "theirs.Theirs"]}}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings))
    make: Any = AutoTokenizer
    with (
        pytest.raises(CheckpointError, match=r"foreign names code of its own .*It is not run"),
        no_foreign_code("pi0_fast"),
    ):
        make.from_pretrained(str(folder), trust_remote_code=True)  # as lerobot asks; it must be in vain
    assert not trace.exists()
    with pytest.raises(Exception):  # noqa: B017  it has no vocabulary: what matters is that it came so far
        make.from_pretrained(str(folder), trust_remote_code=True)  # the code written above, nobody else's
    assert trace.exists()  # so much for the test


@pytest.mark.parametrize(
    ("family", "missing", "message"),
    [
        ("pi0", "tokenizer", r"(?s)'pi0' could not be built.*local folder"),
        ("pi0_fast", "tokenizer", r"(?s)'pi0_fast' could not be built.*local folder"),
        ("pi0_fast", "action_tokenizer_name", r"action tokenizer 'lerobot/.*' cannot be read"),
    ],
)
def test_a_training_without_a_tokenizer_says_which_one_is_missing(
    recorded: Path, tmp_path: Path, tokenizer: Path, family: str, missing: str, message: str
) -> None:
    config = tiny(recorded, tmp_path, tokenizer, family)
    section = dict(config.finetune)
    section["policy"] = {**section["policy"]}
    del (section if missing == "tokenizer" else section["policy"])[missing]
    with tiny_paligemma(family), pytest.raises(CheckpointError, match=message):
        finetune(replace(config, finetune=section))


def tiny(recorded: Path, folder: Path, tokenizer: Path, family: str) -> FinetuneConfig:
    """Return a training of four steps, with both tokenizers."""
    recipe = folder / f"tiny_{family}.yaml"
    recipe.write_text(f"version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {{type: {family}}}\n")
    policy = {**TINY_POLICY, "scheduler_decay_steps": 4}
    if family == "pi0_fast":
        actions = write_tiny_fast_tokenizer(folder / "fast")
        policy = {**TINY_FAST, "action_tokenizer_name": str(actions)}
    return FinetuneConfig(
        policy=str(recipe),
        dataset=str(recorded),
        out=str(folder / "run"),
        finetune={**SHORT, "tokenizer": str(tokenizer), "policy": policy},
        device="cpu",
        allow_unreplayed=True,
    )


class TestTraining:
    @pytest.fixture
    def run(self, recorded: Path, tmp_path: Path, tokenizer: Path, killed_at: KilledAt) -> Path:
        """Train, be killed, go on; then both tokenizers are gone from where they were."""
        read: Any = AutoTokenizer
        text = read.from_pretrained(str(tokenizer))  # random weights answer with any of these
        text.add_tokens([f"<{index}>" for index in range(VOCABULARY - len(text))])
        text.save_pretrained(str(tokenizer))
        config = tiny(recorded, tmp_path, tokenizer, "pi0_fast")
        with tiny_paligemma("pi0_fast"):
            with killed_at(3):
                finetune(config)
            finetune(config)
        tokenizer.rename(tmp_path / "gone")  # the checkpoint has its own
        (tmp_path / "fast").rename(tmp_path / "gone, too")
        return tmp_path / "run"

    def test_a_tiny_one_goes_the_whole_way(self, run: Path) -> None:
        assert run_an_episode(make_tiny(context(), checkpoint=str(run))) == 3

    def test_it_reads_tokens_as_those_of_the_whole_chunk(self, run: Path) -> None:
        """lerobot reads them as those of `n_action_steps`: of a shorter chunk, with other coefficients."""
        file = find_checkpoint(run) / "config.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "n_action_steps": 2}))
        policy = make_tiny(context(), checkpoint=str(run))
        inner: Any = policy._loaded.policy
        chunk = np.linspace(-1, 1, CHUNK * 7).reshape(1, CHUNK, 7)
        tokens = torch.tensor(inner.action_tokenizer(chunk)[0])
        seen: list[Any] = []

        def answer(*_: Any, **__: Any) -> torch.Tensor:
            return (inner._paligemma_tokenizer.vocab_size - 1 - inner.config.fast_skip_tokens - tokens)[None]

        inner.model.sample_actions_fast_kv_cache = answer
        decode = inner.detokenize_actions
        inner.detokenize_actions = lambda *a, **k: seen.append(decode(*a, **k)) or seen[-1]
        assert run_an_episode(policy) == 3
        # A coefficient is rounded to 0.1: each of four is off by at most 0.05, and they are orthonormal.
        np.testing.assert_allclose(seen[0], chunk, atol=0.05 * 2)

    def test_a_checkpoint_is_a_base_with_tokenizers_of_its_own(
        self, run: Path, recorded: Path, tmp_path: Path, tokenizer: Path
    ) -> None:
        config = tiny(recorded, tmp_path, tokenizer, "pi0_fast")
        own = {**SHORT, "steps": 2, "base_checkpoint": str(run), "policy": {"scheduler_decay_steps": 2}}
        (tmp_path / "fast").rename(tmp_path / "gone again")
        with tiny_paligemma("pi0_fast"):
            finetune(replace(config, out=str(tmp_path / "next"), finetune=own))
        made = json.loads((find_checkpoint(tmp_path / "next") / "config.json").read_text())
        folder = find_checkpoint(run)
        assert made["text_tokenizer_name"] == str(folder / "tokenizer")
        assert made["action_tokenizer_name"] == str(folder / "action_tokenizer")

    def test_its_weights_change(self, run: Path) -> None:
        first, last = (weights(run / f"train/checkpoints/00000{step}") for step in (2, 4))
        assert any(not torch.equal(first[name], last[name]) for name in first)
