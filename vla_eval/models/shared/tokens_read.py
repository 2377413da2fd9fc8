"""Listen to what tokenizers make of sentences, wherever a policy calls one: no caller has to report."""

import contextlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any  # transformers is untyped here
from unittest.mock import patch

from vla_eval.models.shared.sentence_reading import SentenceReading

MAX_SENTENCES = 4096  # of which something is kept; a client may ask with another one each time
NO_LIMIT = 1 << 20  # transformers' tokenizers say a number beyond it if they have none


_listeners: list[list[SentenceReading]] = []


def note(reading: SentenceReading) -> None:
    """Tell the listeners, if any, what was read of a text."""
    for listener in _listeners:
        listener.append(reading)


class Readings:
    """What a policy has read of each sentence; the first call with a sentence is listened to."""

    def __init__(self) -> None:
        self.known: dict[str, SentenceReading] = {}
        self._asked: set[str] = set()

    @contextlib.contextmanager
    def of(self, sentences: str | Iterable[str]) -> Iterator[None]:
        """Listen within the context, if one of the sentences is new."""
        asked = list(dict.fromkeys([sentences] if isinstance(sentences, str) else sentences))
        if self._asked.issuperset(asked) or len(self._asked) >= MAX_SENTENCES:
            yield
            return
        with _listening() as heard:
            yield
        self._asked.update(asked)
        plain = {sentence: _plain(sentence) for sentence in sorted(asked, key=len, reverse=True)}
        for one in heard:
            text = _plain(one.sentence)  # with whatever the policy puts around it
            # The longest, since one sentence may be the beginning of another.
            sentence = next((sentence for sentence, words in plain.items() if words in text), None)
            if sentence is not None and sentence not in self.known:
                self.known[sentence] = replace(one, sentence=sentence)


def _plain(text: str) -> str:
    """Return a text without what policies change when they put a prompt around it."""
    return " ".join(text.replace("_", " ").casefold().split())


@contextlib.contextmanager
def _listening() -> Iterator[list[SentenceReading]]:
    heard: list[SentenceReading] = []
    _listeners.append(heard)
    try:
        with _tokenizers_noted():
            yield heard
    finally:
        _listeners.remove(heard)


@contextlib.contextmanager
def _tokenizers_noted() -> Iterator[None]:
    """Let transformers' tokenizers note what they are called with, within the context."""
    transformers = sys.modules.get("transformers")
    if transformers is None:  # then no tokenizer was made
        yield
        return
    base: Any = transformers.PreTrainedTokenizerBase
    original = base.__call__

    def call(self: Any, text: Any = None, *args: Any, **settings: Any) -> Any:
        encoded = original(self, text, *args, **settings)
        texts = [text] if isinstance(text, str) else text
        if isinstance(texts, Sequence) and texts and all(isinstance(one, str) for one in texts):
            for one in dict.fromkeys(texts):
                note(_heard(self, original, one, settings))
        return encoded

    with patch.object(base, "__call__", call):
        yield


def _heard(tokenizer: Any, original: Any, text: str, settings: Mapping[str, Any]) -> SentenceReading:
    """Return what a tokenizer makes of a text with and without its limit."""
    asked = {"add_special_tokens": settings.get("add_special_tokens", True), "padding": False}
    whole = original(tokenizer, text, truncation=False, verbose=False, **asked)["input_ids"]
    kept, limit, how = whole, None, settings.get("truncation")
    if how not in (None, False, "do_not_truncate"):
        limit = settings.get("max_length") or tokenizer.model_max_length
        if len(whole) > limit:
            kept = original(tokenizer, text, truncation=how, max_length=limit, **asked)["input_ids"]
    return SentenceReading(
        sentence=text,
        ids=tuple(int(one) for one in kept),
        n_tokens=len(whole),
        limit=limit if limit is not None and limit < NO_LIMIT else None,
        kept=str(tokenizer.decode(kept, skip_special_tokens=True)),
    )
