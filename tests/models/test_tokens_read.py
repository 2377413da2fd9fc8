"""A sentence that a tokenizer cuts is named, and so are two tasks that become one sentence."""

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from transformers import ByT5Tokenizer, PreTrainedTokenizerBase

from vla_eval.config.prompts import instruction_for
from vla_eval.errors import RemoteReplyError
from vla_eval.models.episodes.sentence import SentenceEncoder
from vla_eval.models.shared.language_processors import byte_tokenizer
from vla_eval.models.shared.sentence_reading import SentenceReading, SentenceWatch, from_wire
from vla_eval.models.shared.tokens_read import MAX_SENTENCES, Readings
from vla_eval.tasks.catalog import task_spec

SEQ, CHAIN = "SeqOfColors3-v0", "ChainOfColors3-v0"
ASKED = "lift the red cube"  # 17 characters
Call = Callable[[Any, str], Any]


def by_bytes() -> Any:
    """One token per byte, and </s> at the end."""
    make: Any = ByT5Tokenizer
    return make(extra_ids=0)


# How policies call their tokenizers; all cut at 8 tokens.
CALLS: Mapping[str, Call] = {
    "a list": lambda t, s: t([s], max_length=8, truncation=True, padding="max_length", return_tensors="pt"),
    "one text": lambda t, s: t(s, max_length=8, truncation=True),
    "by its name": lambda t, s: t(text=[s, "else"], max_length=8, truncation="longest_first", padding=True),
    "the tokenizer's own limit": lambda t, s: setattr(t, "model_max_length", 8) or t([s], truncation=True),
    "within a prompt": lambda t, s: t(f"{s.upper()}\nAnswer:", max_length=8, truncation=True),
}


def read(call: Callable[[], Any], *sentences: str) -> dict[str, SentenceReading]:
    readings = Readings()
    with readings.of(sentences):
        call()
    return readings.known


@pytest.mark.parametrize("how", CALLS)
@pytest.mark.parametrize("make", [by_bytes, byte_tokenizer])
def test_what_a_limit_leaves_is_heard_however_the_tokenizer_is_called(
    make: Callable[[], Any], how: str
) -> None:
    tokenizer = make()
    known = read(lambda: CALLS[how](tokenizer, ASKED), ASKED)
    text = "LIFT THE RED CUBE\nAnswer:" if how == "within a prompt" else ASKED
    reading = known[ASKED]
    # One special token of the 8: </s> of ByT5, <s> of ours.
    assert (len(reading.ids), reading.n_tokens, reading.limit) == (8, len(text) + 1, 8)
    assert reading.kept == text[:7]
    (line,) = SentenceWatch("p").lines(reading, SEQ)
    assert line.startswith(f"policy 'p' reads 8 of the {len(text) + 1} tokens of '{ASKED}' (its limit: 8)")


@pytest.mark.parametrize("limit", range(1, 25))
def test_a_sentence_counts_as_cut_where_the_encoding_lost_a_token(limit: int) -> None:
    tokenizer = by_bytes()
    known = read(lambda: tokenizer([ASKED], max_length=limit, truncation=True), ASKED)
    reading = known[ASKED]
    assert reading.ids == tuple(tokenizer(ASKED, max_length=limit, truncation=True).input_ids)
    assert bool(SentenceWatch("p").lines(reading, SEQ)) == (limit < len(ASKED.encode()) + 1)


@pytest.mark.parametrize("truncation", [None, False, "do_not_truncate"])
def test_a_tokenizer_that_does_not_cut_has_no_limit(truncation: Any) -> None:
    reading = read(lambda: by_bytes()([ASKED], max_length=8, truncation=truncation), ASKED)[ASKED]
    assert (reading.limit, reading.n_tokens, len(reading.ids)) == (None, 18, 18)
    assert SentenceWatch("p").lines(reading, SEQ) == []


def test_what_the_tokenizer_returns_is_what_it_returns_unheard() -> None:
    tokenizer = by_bytes()
    heard: list[Any] = []
    settings: dict[str, Any] = {"max_length": 8, "truncation": True, "padding": "max_length"}
    original = PreTrainedTokenizerBase.__call__
    read(lambda: heard.append(tokenizer([ASKED], return_tensors="pt", **settings)), ASKED)
    assert PreTrainedTokenizerBase.__call__ is original
    alone = tokenizer([ASKED], return_tensors="pt", **settings)
    assert all(torch.equal(heard[0][name], alone[name]) for name in alone)


def test_each_sentence_is_listened_to_once_and_again_after_an_error() -> None:
    tokenizer, readings = by_bytes(), Readings()
    original = PreTrainedTokenizerBase.__call__
    with pytest.raises(ZeroDivisionError), readings.of([ASKED]):
        raise ZeroDivisionError
    assert PreTrainedTokenizerBase.__call__ is original
    with readings.of([ASKED]):
        assert PreTrainedTokenizerBase.__call__ is not original
        tokenizer(ASKED, max_length=8, truncation=True)
    with readings.of(ASKED):
        assert PreTrainedTokenizerBase.__call__ is original
    assert list(readings.known) == [ASKED]


def test_sentences_beyond_a_number_are_not_kept() -> None:
    readings = Readings()
    for number in range(MAX_SENTENCES + 2):
        with readings.of([f"sentence {number}."]):
            pass
    assert len(readings._asked) == MAX_SENTENCES


def test_a_text_belongs_to_the_longest_sentence_that_it_holds() -> None:
    short, long = "lift it", "lift it, please"
    tokenizer = by_bytes()
    known = read(
        lambda: [tokenizer(f"<{text}>", max_length=64, truncation=True) for text in (long, short)],
        short,
        long,
    )
    assert {sentence: one.kept for sentence, one in known.items()} == {long: f"<{long}>", short: f"<{short}>"}


def test_texts_of_no_sentence_are_not_noted() -> None:
    tokenizer = by_bytes()
    assert read(lambda: tokenizer("1 2 3 4 5 6 7 8 9", max_length=4, truncation=True), ASKED) == {}


def test_two_tasks_whose_sentences_begin_alike_are_one_to_a_tokenizer_of_64_bytes() -> None:
    tokenizer, watch = by_bytes(), SentenceWatch("octo")
    sentences = {task: instruction_for(task_spec(task)) for task in (SEQ, CHAIN)}
    known = read(
        lambda: tokenizer(list(sentences.values()), max_length=64, truncation=True, padding=True),
        *sentences.values(),
    )
    lines = [line for task, own in sentences.items() for line in watch.lines(known[own], task)]
    assert len(lines) == 3 and all("reads 64 of the" in line for line in lines[:2])
    assert f"one and the same of two tasks, {sentences[SEQ]!r} ({SEQ}) and {sentences[CHAIN]!r}" in lines[2]
    assert [line for task, own in sentences.items() for line in watch.lines(known[own], task)] == []


def test_words_in_another_order_are_one_sentence_to_a_policy_that_reads_no_order() -> None:
    one, other, third = "red before blue", "Blue before red!", "red before green"
    encoder = SentenceEncoder(4)
    known = read(lambda: encoder([one, other, third]), one, other, third)
    watch = SentenceWatch("memory")
    tasks = {"A": one, "B": other, "C": third}
    lines = [line for task, own in tasks.items() for line in watch.lines(known[own], task)]
    (line,) = lines
    assert f"{other!r} (B) and {one!r} (A): 'before blue red'" in line
    torch.testing.assert_close(encoder([one]), encoder([other]))  # sums in another order


def alike(sentence: str, *ids: int) -> SentenceReading:
    return SentenceReading(sentence=sentence, ids=ids, n_tokens=len(ids), limit=None, kept="k")


def said(*asked: tuple[str, SentenceReading]) -> int:
    watch = SentenceWatch("p")
    return sum(len(watch.lines(reading, task)) for task, reading in asked)


def test_only_two_tasks_with_different_sentences_are_one_and_the_same() -> None:
    one, other, third = alike("a", 1, 2), alike("b", 1, 2), alike("c", 1, 2)
    assert said(("T", one), ("T", other)) == 0  # paraphrases
    assert said(("T", one), ("U", one)) == 0  # the prompt set gives both the same
    assert said(("T", one), ("U", alike("b", 1))) == 0
    assert said(("T", one), ("U", other), ("U", other), ("T", one)) == 1
    assert said(("", one), ("", other)) == 1  # of tasks without names each sentence is one
    for order in itertools.permutations([("T", one), ("U", other), ("V", third)]):
        assert said(*order) == 3


def test_what_a_server_says_is_what_its_client_reads() -> None:
    reading = SentenceReading(sentence="s", ids=(3, 4), n_tokens=9, limit=2, kept="k")
    assert from_wire("s", reading.to_wire(), where="w") == reading


@pytest.mark.parametrize(
    "change",
    [
        {"ids": "34"},
        {"ids": [1.5]},
        {"ids": [True]},
        {"n_tokens": None},
        {"limit": "2"},
        {"kept": 3},
        {"x": 1},
    ],
)
def test_what_a_server_says_in_another_form_is_refused(change: dict[str, Any]) -> None:
    said_of_it = {**alike("s", 1).to_wire(), **change}
    with pytest.raises(RemoteReplyError, match="w: the server says of the sentence"):
        from_wire("s", said_of_it, where="w")
