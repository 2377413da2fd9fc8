"""What a server makes of the sentences of its clients: once in its log, and to clients of its own wire."""

import logging
from dataclasses import replace
from typing import Any

import pytest

from tests.serving.served_policies import CountingPolicy, Running, frame, host
from tests.serving.test_server import Client
from vla_eval.core import EpisodeStart
from vla_eval.models.shared.sentence_reading import SentenceReading
from vla_eval.serving import asked_sentences
from vla_eval.serving.asked_sentences import AskedSentences
from vla_eval.serving.server import ServerOptions

CUT = {"ids": [1, 2], "n_tokens": 9, "limit": 2, "kept": "le"}


class ReadingPolicy(CountingPolicy):
    """Reads two letters of each sentence."""

    def __init__(self) -> None:
        super().__init__()
        self.readings: dict[str, SentenceReading] = {}

    def act_batch(self, windows: Any) -> Any:
        for start in self._starts.values():
            self.readings[start.instruction] = SentenceReading(
                sentence=start.instruction, ids=(1, 2), n_tokens=9, limit=2, kept="le"
            )
        return super().act_batch(windows)


def start(sentence: str, task: str = "any task") -> EpisodeStart:
    return EpisodeStart(slot=0, task=task, seed=1, run=0, instruction=sentence, horizon_steps=9)


def asked(policy: Any, **said: Any) -> AskedSentences:
    hosted = host(policy)
    return AskedSentences(replace(hosted, metadata=replace(hosted.metadata, **said)))


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def test_a_sentence_that_was_never_trained_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    sentences = asked(CountingPolicy(), sentences={"T": ("lift it",)}, weights_sha256="ab" * 32)
    for one in (start("lift it", "T"), start("let go", "T"), start("let go", "T"), start("lift it")):
        sentences.begin(one)
    (line,) = lines(caplog)
    assert "is asked on T with a sentence that it was never trained with: 'let go'" in line


@pytest.mark.parametrize(("weights", "n_lines"), [("ab" * 32, 1), (None, 0)])
def test_a_policy_of_unknown_sentences_is_said_at_the_start_if_it_has_weights(
    weights: str | None, n_lines: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "vla_eval.serving")
    sentences = asked(CountingPolicy(), sentences=None, weights_sha256=weights)
    sentences.begin(start("let go"))
    assert len(lines(caplog)) == n_lines
    assert all("is not known" in line for line in lines(caplog))


def test_what_is_cut_and_what_becomes_one_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    policy = ReadingPolicy()
    sentences = asked(policy)
    assert sentences.answered(start("lift it")) is None  # before the first inference
    for sentence in ("lift it", "let go"):
        policy.readings[sentence] = SentenceReading(sentence=sentence, **{**CUT, "ids": (1, 2)})  # type: ignore[arg-type]
    for sentence in ("lift it", "let go", "lift it"):
        assert sentences.answered(start(sentence)) is policy.readings[sentence]
    assert [line.split("'counting' ")[1][:14] for line in lines(caplog)] == [
        *("reads 2 of the", "reads 2 of the", "reads one and ")
    ]


def test_a_client_that_asks_with_another_sentence_each_time_fills_no_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(asked_sentences, "MAX_SENTENCES", 3)
    sentences = asked(CountingPolicy(), sentences={"T": ("lift it",)})
    for number in range(9):
        sentences.begin(start(f"lift {number}"))
    assert len(sentences._begun) == 3


def test_a_client_of_this_wire_is_told_once_per_sentence_and_others_never() -> None:
    server = Running(host(ReadingPolicy()), ServerOptions(port=0))
    try:
        ours, openpis = Client(server), Client(server)
        ours.ask(endpoint="reset", **frame(prompt="lift it"))
        replies = [ours.ask(**frame(prompt="lift it")) for _ in range(2)]
        ours.ask(endpoint="reset", **frame(prompt="let go"))
        replies += [ours.ask(**frame(prompt="let go")) for _ in range(2)]
        assert [reply.get("sentence_read") for reply in replies] == [CUT, None, CUT, None]
        assert openpis.ask(**frame(prompt="lift it")).keys() == {"actions", "server_timing"}
    finally:
        server.stop()
        server.wait()
