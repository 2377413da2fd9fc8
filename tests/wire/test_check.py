"""`check_remote`: a server that keeps the protocol passes; for each kind of fault it says what is wrong."""

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import serve

from tests.mikasa_vla_client.serving import (
    HOLDABLE_SPEC,
    MEMORY_SPEC,
    PLAIN_SPEC,
    HeldSums,
    MixedSums,
    Sums,
    client,
    served,
)
from vla_eval.errors import ConformanceError
from vla_eval.testing.check_remote import check_remote
from vla_eval.wire.codec import packb


class SessionPolicy(Sums):
    """The plugin's policy with one fault."""

    def __init__(self, fault: str) -> None:
        self._fault, self._rng, self._n_calls = fault, np.random.default_rng(0), 0

    def reset(self, session: Any, episode: Any) -> None:
        super().reset(session, episode)
        if self._fault == "time":
            session.memory = self._rng.normal()

    def infer(self, session: Any, observation: Any) -> Any:
        chunk = super().infer(session, observation)
        return chunk + np.nan if self._fault == "nan" else chunk


@contextlib.contextmanager
def first_message(data: bytes | str) -> Iterator[str]:
    """A server that says this and nothing else."""
    with serve(lambda socket: (socket.send(data), socket.recv())[0], "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join()


def test_a_policy_with_memory_by_session_passes_and_the_check_says_what_it_tried() -> None:
    said: list[str] = []
    with served(Sums()) as url:
        met = check_remote(url, report=said.append)
    assert met == said
    assert "Two sessions side by side on one connection get what each gets alone." in met
    assert "Two sessions side by side on two connections get what each gets alone." in met
    assert "Refused with a text: an image of another shape." in met
    assert "Refused with a text: a state with a number that is infinite." in met
    assert met[-1] == "After refused messages the server answers as before."


def test_a_memory_that_can_be_held_is_moved_to_another_session() -> None:
    with served(HeldSums(), HOLDABLE_SPEC) as url:
        met = check_remote(url)
    assert any("continues with the memory that was read, in another session" in claim for claim in met)
    assert "Refused with a text: a memory for a session without an episode." in met


class Incomplete(HeldSums):
    """Hands out a memory with one fault."""

    def __init__(self, fault: str) -> None:
        self._fault = fault

    def get_memory(self, session: Any) -> Any:
        faults: dict[str, Any] = {
            "rounded": {"sum": np.array([round(session.memory)], np.float64)},
            "no numbers": {"sum": np.array(["1"])},
            "no map": [np.zeros(1)],
            "too large": {"sum": np.zeros((5_000_000,), np.float64)},
        }
        return faults.get(self._fault, super().get_memory(session))

    def set_memory(self, session: Any, memory: Any) -> None:
        if self._fault != "not replaced":
            super().set_memory(session, memory)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("rounded", "its actions are the same. Found: inference"),
        ("not replaced", "its actions are the same. Found: inference"),
        ("no numbers", "expected arrays of numbers by name, found 'sum': <U1"),
        ("no map", "expected a map of at most 1024 arrays, found list"),
        ("too large", "expected at most 33554432 bytes, found 40000000"),
    ],
)
def test_what_is_wrong_with_a_memory_is_said(fault: str, says: str) -> None:
    with served(Incomplete(fault), HOLDABLE_SPEC) as url, pytest.raises(ConformanceError) as info:
        check_remote(url)
    assert says in str(info.value)


def test_a_function_passes() -> None:
    with served(lambda seen: np.full((2, 7), seen["observation/state"].sum()), PLAIN_SPEC) as url:
        assert "It takes the state as `eef`." in check_remote(url)


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        (MixedSums(), {}, r"Two sessions .* Keep the policy's memory by `session_id`"),
        (SessionPolicy("time"), {}, r"The same seed .* Draw random numbers from a generator"),
        (SessionPolicy("nan"), {}, "a request that keeps the protocol was refused: .*not finite"),
        (Sums(), {"debug": True}, r"An error is one message, without a traceback\. Found: Traceback"),
        (Sums(), {"api_key": "secret"}, "no connection: .*401"),
    ],
)
def test_a_fault_is_named(policy: Any, options: dict[str, Any], message: str) -> None:
    with served(policy, MEMORY_SPEC, **options) as url, pytest.raises(ConformanceError, match=message):
        check_remote(url)


def test_a_server_that_takes_a_state_of_nan_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def unchecked(value: Any, _names: Any) -> Any:
        if np.shape(value) != (25,):
            raise ValueError("another shape")
        return value

    monkeypatch.setattr("mikasa_vla_client.spec.as_state", unchecked)
    with (
        served(Sums(), MEMORY_SPEC) as url,
        pytest.raises(
            ConformanceError, match="Refused with a text: a state with a number that is not a number"
        ),
    ):
        check_remote(url)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("weights_sha256", "abc", "`weights_sha256` is 64 hexadecimal digits, .* Found: 'abc'"),
        ("chunk_size", None, "`chunk_size` is a number ≥ 1. Found: None"),
        ("cameras", {"base_camera": "image"}, "`cameras` is a map"),
        ("supports", ["reset", "observe"], "`supports` has 'seed'"),
    ],
)
def test_a_wrong_first_message_is_named(field: str, value: Any, message: str) -> None:
    said = {**MEMORY_SPEC.metadata(), field: value}
    with served(Sums()) as url, pytest.MonkeyPatch.context() as patch:
        patch.setattr("vla_eval.wire.check_client.Server.first_message", lambda _: said)
        with pytest.raises(ConformanceError, match=message):
            check_remote(url)


def test_of_a_plain_server_of_openpis_the_check_says_what_it_could_not_try() -> None:
    with first_message(packb({"env": "libero"})) as url:
        met = check_remote(url)
    assert met[0] == "The server sends a map as its first message."
    assert met[1].startswith("Not tried: inference.") and f"remote_openpi@{url}" in met[1]


@pytest.mark.parametrize(
    ("data", "message"),
    [("hello", "expected a map as the first message, found the text: hello"), (b"\xc1", "expected msgpack")],
)
def test_another_program_behind_the_address_is_named(data: bytes | str, message: str) -> None:
    with first_message(data) as url, pytest.raises(ConformanceError, match=message):
        check_remote(url)


def test_no_server_is_one_message() -> None:
    with pytest.raises(ConformanceError, match=r"ws://127.0.0.1:1: no connection: .* Start the server first"):
        check_remote("ws://127.0.0.1:1")


def test_the_plugin_checks_with_the_same_code(capsys: pytest.CaptureFixture[str]) -> None:
    from mikasa_vla_client.__main__ import main

    with served(Sums()) as url:
        assert main([url]) == 0
    assert capsys.readouterr().out.startswith("ok  GET /healthz answers 200.\n")
    assert main(["ws://127.0.0.1:1"]) == 1
    assert "no connection" in capsys.readouterr().err
    with pytest.raises(client.CheckFailedError):
        client.check_remote("ws://127.0.0.1:1")


def test_a_server_that_waits_for_a_greeting_is_named_as_one_of_another_protocol() -> None:
    with serve(lambda socket: socket.recv(timeout=10), "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        with pytest.raises(ConformanceError, match=r"no reply within 0\.2 s.* name a recipe"):
            check_remote(url, timeout_seconds=0.2)
        server.shutdown()
        thread.join()
