"""How many tokens of a sentence a policy gets, and which tasks become one to it. Standard library."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable  # Any: what a server says

from vla_eval.errors import MAX_SHOWN, RemoteReplyError
from vla_eval.plain_text import printable
from vla_eval.strict.json_text import shown

MAX_TOKENS = 1 << 16  # of a sentence that a server has read


def quoted(sentence: str) -> str:
    """Return a sentence in quotes, in one printable line; of a very long one, beginning and end."""
    half = MAX_SHOWN // 2
    is_long = len(sentence) > MAX_SHOWN
    return f"'{printable(f'{sentence[:half]} … {sentence[-half:]}' if is_long else sentence)}'"


@dataclass(frozen=True, slots=True, kw_only=True)
class SentenceReading:
    """What a policy's network is given of a sentence."""

    sentence: str  # as the policy was asked
    # the tokens that the network gets, with those that the policy puts around the sentence
    ids: tuple[int, ...]
    n_tokens: int  # how many there would be without a limit
    limit: int | None  # how many are read at most; None: all
    kept: str  # the text of `ids`

    def to_wire(self) -> dict[str, Any]:
        """Return it as a server sends it: without the sentence, which its client knows."""
        return {"ids": list(self.ids), "n_tokens": self.n_tokens, "limit": self.limit, "kept": self.kept}


def from_wire(sentence: str, said: object, *, where: str) -> SentenceReading:
    """Return what a server reports of a sentence; raise `RemoteReplyError` if it has another form."""
    if isinstance(said, Mapping) and said.keys() == {"ids", "n_tokens", "limit", "kept"}:
        ids, n_tokens, limit, kept = (said[name] for name in ("ids", "n_tokens", "limit", "kept"))
        is_list = isinstance(ids, list) and len(ids) <= MAX_TOKENS
        numbers = [n_tokens, *(() if limit is None else (limit,)), *(ids if is_list else ())]
        if is_list and isinstance(kept, str) and all(type(number) is int for number in numbers):
            return SentenceReading(
                sentence=sentence, ids=tuple(ids), n_tokens=n_tokens, limit=limit, kept=kept
            )
    raise RemoteReplyError(
        f"{where}: the server says of the sentence that it has read {shown(said)}; expected its tokens (ids, "
        "n_tokens, limit, kept). Use the same version of mikasa-vla-eval at both ends."
    )


@runtime_checkable
class ReadingPolicy(Protocol):
    """A policy that knows what its network was given of the sentences it was asked with."""

    @property
    def readings(self) -> Mapping[str, SentenceReading]:
        """Sentence -> what was read of it; grows with the first inference of each."""


class SentenceWatch:
    """Reports once of each sentence that it was cut, and once of two tasks that they became one sentence."""

    def __init__(self, policy: str) -> None:
        self._policy = policy
        self._tasks: dict[str, set[str]] = {}  # sentence -> its tasks
        self._alike: dict[tuple[int, ...], list[SentenceReading]] = {}
        self._said: set[frozenset[str]] = set()

    def lines(self, reading: SentenceReading, task: str) -> list[str]:
        """Return what is new of a sentence; with an empty id, each sentence is a task of its own."""
        said = []
        alike = self._alike.setdefault(reading.ids, [])
        if reading.sentence not in self._tasks:
            alike.append(reading)
            if reading.n_tokens > len(reading.ids):
                said.append(
                    f"policy '{self._policy}' reads {len(reading.ids)} of the {reading.n_tokens} tokens of "
                    f"{quoted(reading.sentence)} (its limit: {reading.limit}). What is left: "
                    f"{quoted(reading.kept)}. Use a shorter sentence, or train with a higher limit where the "
                    "policy's configuration has one."
                )
        own = self._tasks.setdefault(reading.sentence, set())
        own.add(task or reading.sentence)
        for other in alike:
            pair = frozenset((other.sentence, reading.sentence))
            if len(pair) == 2 and pair not in self._said and not own & self._tasks[other.sentence]:
                self._said.add(pair)
                # By their sentences: which of them a worker reads first is chance.
                one, two = sorted((other, reading), key=lambda one: one.sentence)
                said.append(
                    f"policy '{self._policy}' reads one and the same of two tasks, {self._named(one)} and "
                    f"{self._named(two)}: {quoted(one.kept)}. It can distinguish them by what it sees alone. "
                    "Use sentences that differ in what is read."
                )
        return said

    def _named(self, one: SentenceReading) -> str:
        tasks = sorted(self._tasks[one.sentence] - {one.sentence})
        return quoted(one.sentence) + (f" ({', '.join(tasks)})" if tasks else "")
