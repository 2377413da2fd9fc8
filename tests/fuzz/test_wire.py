"""Random bytes and random arrays from a socket: they are read, or refused with a message."""

import functools
import json
from collections.abc import Collection
from typing import Any

import msgpack
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.json_cases import NAMES, accepted_or_refused
from tests.wire.small_servers import OURS
from vla_eval.core import EpisodeStart
from vla_eval.errors import RemoteConnectionError, RemoteReplyError
from vla_eval.policies.remote.actions import as_rows
from vla_eval.policies.remote.settings import RemoteSettings
from vla_eval.policies.remote.vla_eval_dialect import VlaEvalClient
from vla_eval.wire.client import OpenpiClient
from vla_eval.wire.codec import CodecError, packb, unpackb
from vla_eval.wire.metadata import ServerMetadata

LEAVES = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.binary(max_size=40)
LEAVES |= st.text(alphabet=st.characters(exclude_categories=["Cs"]), max_size=8)
KEYS = st.sampled_from(["__ndarray__", "__npgeneric__", "data", "dtype", "shape"])
KEYS |= st.text(alphabet="ab/", max_size=3)
DTYPES = st.sampled_from(["<f4", "|u1", "|b1", "<U2", ">i8", "|O", "|V3", "<c8", "S0", "f4,i4"]) | st.text(
    max_size=6
)
DTYPES = DTYPES.filter(lambda text: not any("\ud800" <= letter <= "\udfff" for letter in text))
SHAPES = st.lists(st.integers(-2, 2**64 - 1) | st.integers(0, 4), max_size=20)
ARRAYS = st.fixed_dictionaries(
    {"__ndarray__": st.just(True)},
    optional={"data": st.binary(max_size=64) | LEAVES, "dtype": DTYPES | LEAVES, "shape": SHAPES | LEAVES},
)
SCALARS = st.fixed_dictionaries({"__npgeneric__": st.just(True), "data": LEAVES, "dtype": DTYPES | LEAVES})


def with_bytes_as_keys(message: dict[str, Any]) -> dict[bytes, Any]:
    return {key.encode(): value for key, value in message.items()}


MAPS = ARRAYS | SCALARS | ARRAYS.map(with_bytes_as_keys) | SCALARS.map(with_bytes_as_keys)
MESSAGES = st.recursive(
    LEAVES | MAPS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(KEYS | KEYS.map(str.encode), inner, max_size=4)
    ),
    max_leaves=8,
)


def read_or_refused(data: bytes) -> None:
    """What is read can be written and is then the same; what is refused has a message."""
    try:
        message = unpackb(data)
    except CodecError as exc:
        assert 0 < len(str(exc)) < 1_000
        str(exc).encode("utf-8")
        return
    assert packb(unpackb(packb(message))) == packb(message)


@given(data=st.binary(max_size=200))
def test_random_bytes_are_read_or_refused(data: bytes) -> None:
    read_or_refused(data)


@given(message=MESSAGES, cut=st.integers(0, 200), noise=st.binary(max_size=4))
def test_messages_that_nearly_fit_are_read_or_refused(message: Any, cut: int, noise: bytes) -> None:
    whole = msgpack.packb(message)
    for data in (whole, whole[:cut] + noise + whole[cut + 1 :]):
        read_or_refused(data)


@given(
    shape=st.lists(st.integers(0, 4), max_size=4),
    dtype=st.sampled_from([np.bool_, np.uint8, np.int64, np.float16, np.float32, ">f8"]),
    names=st.lists(NAMES, min_size=1, max_size=3, unique=True),
    seed=st.integers(0, 100),
)
def test_observations_come_back_as_they_were(
    shape: list[int], dtype: Any, names: list[str], seed: int
) -> None:
    array = np.random.default_rng(seed).integers(0, 2, size=shape).astype(dtype)
    sent = {name.encode("utf-8", "ignore").decode(): array for name in names}
    back = unpackb(packb(sent))
    if isinstance(back, dict):
        assert back.keys() == sent.keys()
        for value in back.values():
            np.testing.assert_array_equal(value, array)


# ----------------------------------------------------------------------------------- messages of a server

SMALL_ARRAYS = st.sampled_from(
    [np.zeros(2), np.zeros((4, 7), dtype=np.float32), np.array("text"), np.float32(1)]
)
VALUES = st.recursive(
    LEAVES | SMALL_ARRAYS | st.sampled_from(["s", "reset", "action", "error", "hello", 0, 1, 2]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab", max_size=2), inner, max_size=3),
    max_leaves=4,
)


def some_of_the_fields(*names: str) -> st.SearchStrategy[dict[str, Any]]:
    return st.dictionaries(st.sampled_from(names) | st.text("ab", max_size=2), VALUES, max_size=len(names))


@given(change=some_of_the_fields(*OURS))
def test_what_a_server_says_of_itself_is_read_or_refused(change: dict[str, Any]) -> None:
    def read() -> None:
        metadata = ServerMetadata.from_wire({**OURS, **change}, where="ws://here:1")
        json.dumps(metadata.identity(), allow_nan=False)
        unpackb(packb(metadata.to_wire()))

    accepted_or_refused(read)


class ScriptedConnection:
    """A connection on which the given messages arrive."""

    url = "ws://here:1"

    def __init__(self, *messages: Any) -> None:
        self._messages = list(messages)

    def send(self, message: Any) -> None:
        packb(message)

    def receive(self, *, accept_text: Collection[str] = ()) -> Any:
        if not self._messages:
            raise RemoteConnectionError("nothing more comes")
        return self._messages.pop(0)

    def refuse(self, problem: str) -> RemoteReplyError:
        return RemoteReplyError(problem)

    def close(self) -> None:
        """There is nothing to close."""


START = EpisodeStart(slot=0, task="T-v0", seed=1, run=0, instruction="touch it", horizon_steps=8)


def an_inference(client: Any) -> None:
    client.ask_reset("s", START)
    client.take_reset("s")
    client.ask_infer("s", {}, step=0)
    as_rows(client.take_infer("s"))


@given(
    first=some_of_the_fields("status", "session_id", "step") | VALUES,
    then=some_of_the_fields("actions", "session_id", "step", "error", "message") | VALUES,
    is_ours=st.booleans(),
)
def test_random_replies_are_actions_or_refused(first: Any, then: Any, is_ours: bool) -> None:
    says = OURS if is_ours else {"needs_session_id": True}
    accepted_or_refused(lambda: an_inference(OpenpiClient(ScriptedConnection(says, first, then))))


HELLO = {"type": "hello", "payload": {"protocol_version": 1}, "seq": 1, "timestamp": 0.0}


@given(
    hello=some_of_the_fields("type", "payload", "seq"),
    then=some_of_the_fields("type", "payload", "seq") | VALUES,
)
def test_random_messages_of_vla_eval_are_actions_or_refused(hello: dict[str, Any], then: Any) -> None:
    for first in (HELLO, {**HELLO, **hello}):
        connection = ScriptedConnection(first, then)
        accepted_or_refused(functools.partial(greet_and_infer, connection))


def greet_and_infer(connection: Any) -> None:
    an_inference(VlaEvalClient(connection, RemoteSettings(url="ws://here:1", dialect="vla_eval")))
