"""The server: openpi's words, sessions, keys, health, metrics, errors and the end."""

import asyncio
import time
import urllib.error
import urllib.request
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tests.serving.served_policies import CHUNK_SIZE, CountingPolicy, Running, frame, host, serving
from tests.waiting import wait_until
from vla_eval.serving import sessions
from vla_eval.serving.server import PolicyServer, ServeError, ServerOptions
from vla_eval.wire.codec import packb, unpackb
from vla_eval.wire.metadata import ServerMetadata


class Client:
    """openpi's client: one question, one answer."""

    def __init__(self, server: Running, key: str | None = None) -> None:
        headers = {} if key is None else {"Authorization": f"Api-Key {key}"}
        opened = connect(server.url, compression=None, max_size=None, additional_headers=headers)
        self.socket: ClientConnection = opened.__enter__()  # closed by the server's end
        self.metadata = unpackb(self.socket.recv(timeout=10))

    def send(self, **fields: Any) -> None:
        self.socket.send(packb(fields))

    def receive(self) -> Any:
        answer = self.socket.recv(timeout=10)
        return unpackb(answer) if isinstance(answer, bytes) else answer

    def ask(self, **fields: Any) -> Any:
        self.send(**fields)
        return self.receive()

    def close_code(self) -> int | None:
        with pytest.raises(ConnectionClosed):
            while True:
                self.socket.recv(timeout=10)
        return self.socket.close_code


def get(server: Running, path: str, key: str | None = None) -> tuple[int, str]:
    headers = {} if key is None else {"Authorization": f"Api-Key {key}"}
    asked = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(asked, timeout=10) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as exc:
        return exc.code, exc.read().decode()


def values(reply: dict[str, Any]) -> tuple[float, ...]:
    """Return seed, step and number of frames of a chunk."""
    return tuple(float(value) for value in reply["actions"][0, :3])


class TestOpenpisClient:
    def test_it_gets_chunks_without_knowing_of_sessions(self) -> None:
        with serving(CountingPolicy()) as server:
            client = Client(server)
            first, second = client.ask(**frame()), client.ask(**frame())

        assert first["actions"].shape == (CHUNK_SIZE, 7) and first["actions"].dtype == np.float32
        assert (values(first), values(second)) == ((0, 0, 1), (0, 1, 2))
        assert set(first["server_timing"]) == {"infer_ms", "queue_ms"}
        assert set(second["server_timing"]) == {"infer_ms", "queue_ms", "prev_total_ms"}

    def test_the_first_message_says_what_is_served(self) -> None:
        with serving(CountingPolicy(), n_rows=3) as server:
            said = ServerMetadata.from_wire(Client(server).metadata, where="here")

        assert (said.name, said.batch_max, said.chunk_size, said.n_sessions) == ("counting", 3, CHUNK_SIZE, 0)
        assert said.is_ours and said.takes_reset

    def test_each_connection_is_an_episode_of_its_own(self) -> None:
        with serving(CountingPolicy(), n_rows=2) as server:
            one, two = Client(server), Client(server)
            assert [values(client.ask(**frame()))[2] for client in (one, one, two)] == [1, 2, 1]


class TestSessions:
    def test_sessions_of_a_connection_are_answered_under_their_names(self) -> None:
        policy = CountingPolicy(reads="every")
        with serving(policy, n_rows=2) as server:
            client = Client(server)
            for seed, name in enumerate("ab"):
                reply = client.ask(
                    endpoint="reset", session_id=name, prompt="remember", seed=seed, row=seed, step=0
                )
                assert (reply["status"], reply["session_id"]) == ("reset", name)
            client.send(**frame(endpoint="observe", session_id="a", step=0))  # has no answer
            client.send(**frame(endpoint="infer", session_id="a", step=1))
            client.send(**frame(endpoint="infer", session_id="b", step=0))
            replies = {reply["session_id"]: reply for reply in (client.receive(), client.receive())}

        assert (values(replies["a"]), values(replies["b"])) == ((0, 1, 2), (1, 0, 1))
        assert (replies["a"]["step"], replies["b"]["step"]) == (1, 0)

    def test_a_reset_forgets_the_episode_before(self) -> None:
        with serving(CountingPolicy()) as server:
            client = Client(server)
            client.ask(**frame())
            client.ask(endpoint="reset", prompt="look", seed=4)
            assert values(client.ask(**frame(prompt="look"))) == (4, 0, 1)

    def test_sessions_end_with_their_connection(self) -> None:
        policy = CountingPolicy()
        with serving(policy) as server:
            client = Client(server)
            client.ask(**frame())
            client.socket.close()
            wait_until(lambda: policy.forgotten == [0])
            assert Client(server).metadata["n_sessions"] == 0

    def test_an_idle_session_is_dropped(self) -> None:
        policy = CountingPolicy()
        with serving(policy, idle_seconds=0.2) as server:
            client = Client(server)
            client.ask(**frame(session_id="s"))
            wait_until(lambda: policy.forgotten == [0])
            assert "'s' was dropped" in client.ask(**frame(session_id="s"))

    def test_a_client_with_too_many_sessions_loses_its_own_and_nobody_elses(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sessions, "MAX_SESSIONS_OF_CONNECTION", 2)
        policy = CountingPolicy()
        with serving(policy) as server:
            other, greedy = Client(server), Client(server)
            other.ask(**frame(session_id="s"))
            for n in range(10):
                greedy.ask(**frame(session_id=f"s{n}"))
            assert values(other.ask(**frame(session_id="s"))) == (0, 1, 2)
            assert policy.forgotten == [1, 2] * 4
            assert "'s7' was dropped, since it was the idlest of more than 2" in greedy.ask(
                **frame(session_id="s7")
            )
            assert greedy.close_code() == 1011
            assert values(other.ask(**frame(session_id="s"))) == (0, 2, 3)


class TestErrors:
    @pytest.mark.parametrize(
        ("request_", "message"),
        [
            (frame(endpoint="resett"), "Did you mean 'reset'"),
            ({"prompt": "look"}, "the request has no 'observation/state'"),
            ({"observation/state": np.zeros(9, np.float32)}, "the request has no 'prompt'"),
            (frame(endpoint="observe"), "'observe' without an episode"),
        ],
    )
    def test_a_wrong_request_gets_one_message_and_the_end(
        self, request_: dict[str, Any], message: str
    ) -> None:
        with serving(CountingPolicy()) as server:
            client = Client(server)
            answer = client.ask(**request_)
            assert message in answer and "Traceback" not in answer
            assert client.close_code() == 1011
            assert values(Client(server).ask(**frame())) == (0, 0, 1)  # others are served

    def test_arrays_in_the_format_of_msgpack_numpy_are_named(self) -> None:
        state = np.zeros(9, np.float32)
        packed = {b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [9], b"data": state.tobytes()}
        with serving(CountingPolicy()) as server:
            client = Client(server)
            client.socket.send(msgpack.packb(frame(**{"observation/state": packed})))
            answer = client.receive()
            assert "an array as msgpack-numpy packs it; expected arrays as openpi-client packs them" in answer
            assert client.close_code() == 1011

    @pytest.mark.parametrize("data", ["text", b"\xc1", packb([1])])
    def test_what_is_no_request_is_refused(self, data: str | bytes) -> None:
        with serving(CountingPolicy()) as server:
            client = Client(server)
            client.socket.send(data)
            answer = client.receive()
            assert "expected" in answer or "cannot be read" in answer
            assert client.close_code() == 1011

    @pytest.mark.parametrize("debug", [False, True])
    def test_an_error_of_the_policy_has_a_traceback_only_in_debug(self, debug: bool) -> None:
        with serving(CountingPolicy(bad_seed=0), debug=debug) as server:
            answer = Client(server).ask(**frame())
        assert "ArithmeticError: a bad episode" in answer
        assert ("Traceback" in answer) == debug

    def test_a_bad_session_does_not_end_those_of_others(self) -> None:
        with serving(CountingPolicy(bad_seed=1), n_rows=2) as server:
            good, bad = Client(server), Client(server)
            good.ask(endpoint="reset", prompt="look", seed=0)
            bad.ask(endpoint="reset", prompt="look", seed=1)
            assert "a bad episode" in bad.ask(**frame(prompt="look"))
            assert values(good.ask(**frame(prompt="look"))) == (0, 0, 1)


class TestHttp:
    def test_health_needs_no_key_and_metrics_count(self) -> None:
        with serving(CountingPolicy(), api_key="secret") as server:
            Client(server, key="secret").ask(**frame())
            assert get(server, "/healthz") == (200, "OK\n")
            assert get(server, "/metrics")[0] == 401
            status, text = get(server, "/metrics", key="secret")

        assert status == 200
        lines = text.splitlines()
        assert "mikasa_vla_inferences_total 1" in lines and "mikasa_vla_sessions 1" in lines
        assert "# TYPE mikasa_vla_inferences_total counter" in lines

    @pytest.mark.parametrize("key", [None, "wrong", "sécret"])
    def test_a_client_without_the_key_is_refused(self, key: str | None) -> None:
        with serving(CountingPolicy(), api_key="secret") as server:
            with pytest.raises((InvalidStatus, UnicodeEncodeError), match=r"401|encode"):
                Client(server, key=key)
            assert values(Client(server, key="secret").ask(**frame())) == (0, 0, 1)

    @pytest.mark.parametrize(
        "origin", ["http://page.example", "http://127.0.0.1:{port}", "null", "file://", ""]
    )
    @pytest.mark.parametrize("key", [None, "secret"])
    def test_a_client_with_an_origin_is_refused_and_told_to_leave_it_out(
        self, origin: str, key: str | None, caplog: pytest.LogCaptureFixture
    ) -> None:
        with serving(CountingPolicy(), api_key=key) as server:
            headers = {} if key is None else {"Authorization": f"Api-Key {key}"}
            sent = Origin(origin.format(port=server.port))
            with (
                pytest.raises(InvalidStatus, match="403") as refused,
                connect(server.url, additional_headers={**headers, "origin": sent}, proxy=None),
            ):
                pass
            assert values(Client(server, key=key).ask(**frame())) == (0, 0, 1)
        logged = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
        for text in ((refused.value.response.body or b"").decode(), *logged):
            assert "leave that header out" in text and "suppress_origin=True" in text
        assert len(logged) == 1 and "from 127.0.0.1" in logged[0]


class TestTheEnd:
    def test_the_pass_under_way_is_answered_then_the_connection_is_closed(self) -> None:
        policy = CountingPolicy()
        policy.hold.clear()
        with serving(policy) as server:
            client = Client(server)
            client.send(**frame())
            assert policy.begun.wait(10)
            server.stop()
            time.sleep(0.1)  # the server has heard of it
            policy.hold.set()
            assert values(client.receive()) == (0, 0, 1)
            assert client.close_code() == 1001
            server.wait()

    def test_a_port_in_use_is_a_message(self) -> None:
        with serving(CountingPolicy()) as server:
            another = PolicyServer(host(CountingPolicy()), ServerOptions(port=server.port))
            with pytest.raises(ServeError, match=f"cannot listen on 127.0.0.1:{server.port}.*Choose another"):
                asyncio.run(another.run(asyncio.Event(), lambda *_: None))
