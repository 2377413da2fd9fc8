"""One connection to a server: what it refuses, and that nothing is used after an error."""

import contextlib
import http
import threading
import time
from typing import Any

import pytest
from websockets.sync.server import ServerConnection

from tests.wire.small_servers import serving
from vla_eval.errors import RecipeError, RemoteConnectionError, RemoteReplyError, RemoteTimeoutError
from vla_eval.wire.addresses import address_name, is_loopback, named_server, split_urls
from vla_eval.wire.codec import packb
from vla_eval.wire.connection import Connection


def echo(connection: ServerConnection) -> None:
    for frame in connection:
        connection.send(frame)


@contextlib.contextmanager
def connected(url: str, **kwargs: Any):  # type: ignore[no-untyped-def]
    connection = Connection(url, **{"timeout_seconds": 5.0, **kwargs})
    try:
        yield connection
    finally:
        connection.close()


def test_a_message_goes_out_and_comes_back() -> None:
    with serving(echo) as url, connected(url) as connection:
        connection.send({"x": [1, 2]})
        assert connection.receive() == {"x": [1, 2]}


def test_a_late_reply_is_never_received() -> None:
    def late(connection: ServerConnection) -> None:
        for _ in connection:
            time.sleep(0.5)
            connection.send(packb({"late": True}))

    with serving(late) as url, connected(url, timeout_seconds=0.1) as connection:
        connection.send({})
        with pytest.raises(RemoteTimeoutError, match=r"no reply within 0\.1 s"):
            connection.receive()
        time.sleep(0.6)  # the reply has been sent
        with pytest.raises(RemoteConnectionError):
            connection.receive()
        with pytest.raises(RemoteConnectionError):
            connection.send({})


def test_without_a_server_one_message_says_what_to_do() -> None:
    with serving(echo) as url:
        pass  # a port where nobody listens any more
    with pytest.raises(RemoteConnectionError, match=rf"{url}: expected a policy server.*mikasa-vla serve"):
        Connection(url, timeout_seconds=1.0)


def test_a_server_that_starts_late_is_waited_for() -> None:
    with serving(echo) as url:
        port = int(url.rsplit(":", 1)[1])
    found = []
    thread = threading.Thread(
        target=lambda: found.append(Connection(url, timeout_seconds=5.0, connect_seconds=10.0))
    )
    thread.start()
    time.sleep(0.3)
    with serving(echo, port=port):
        thread.join()
        found[0].close()


def test_a_text_frame_is_an_error_of_the_server() -> None:
    def refuse(connection: ServerConnection) -> None:
        connection.recv()
        connection.send("Traceback (most recent call last):\nValueError: no such camera")

    with serving(refuse) as url, connected(url) as connection:
        connection.send({})
        with pytest.raises(RemoteReplyError, match="no such camera"):
            connection.receive()


def test_a_long_error_is_shortened_to_its_end() -> None:
    with (
        serving(lambda connection: connection.send("x" * 100_000 + " the cause")) as url,
        connected(url) as connection,
        pytest.raises(RemoteReplyError, match="the cause") as error,
    ):
        connection.receive()
    assert len(str(error.value)) < 3_000


def test_an_end_of_the_server_is_an_error_with_its_reason() -> None:
    with (
        serving(lambda connection: connection.close(1011, "out of memory")) as url,
        connected(url) as connection,
        pytest.raises(RemoteConnectionError, match="1011, out of memory"),
    ):
        connection.receive()


def test_bytes_that_are_no_message_are_refused() -> None:
    with (
        serving(lambda connection: connection.send(b"\xc1\xc1")) as url,
        connected(url) as connection,
        pytest.raises(RemoteReplyError, match="msgpack"),
    ):
        connection.receive()


def test_more_than_64_mib_are_refused() -> None:
    def flood(connection: ServerConnection) -> None:
        connection.send(b"\0" * (64 * 2**20 + 1))
        connection.recv()

    with (
        serving(flood) as url,
        connected(url) as connection,
        pytest.raises(RemoteConnectionError, match="closed"),
    ):
        connection.receive()


def test_what_answers_but_is_no_policy_server_is_an_error() -> None:
    def page(connection: ServerConnection, request: Any) -> Any:
        return connection.respond(http.HTTPStatus.NOT_FOUND, "nothing here")

    with (
        serving(echo, process_request=page) as url,
        pytest.raises(RemoteConnectionError, match="HTTP 404"),
    ):
        Connection(url, timeout_seconds=1.0)


def test_the_api_key_goes_into_a_header_and_a_missing_one_is_named() -> None:
    def check(connection: ServerConnection, request: Any) -> Any:
        if request.headers.get("Authorization") != "Api-Key secret":
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "no")
        return None

    with serving(echo, process_request=check) as url:
        with connected(url, api_key="secret") as connection:
            connection.send({})
        with pytest.raises(RemoteConnectionError, match="API key"):
            Connection(url, timeout_seconds=1.0)


@pytest.mark.parametrize(
    "url",
    [
        "http://x:1",
        "ws://",
        "ws://:80",
        "ws://a:b",
        "ws://a:99999",
        "ws://u:p@a:1",
        "ws://a b:1",
        "ws://[::1",
        "",
    ],
)
def test_what_is_not_an_address_is_refused(url: str) -> None:
    with pytest.raises(RecipeError, match="is not the address of a policy server"):
        split_urls(f"ws://good:1,{url}")


def test_addresses_are_split_and_named() -> None:
    assert split_urls("ws://a:1/, wss://b.c:2") == ("ws://a:1", "wss://b.c:2")
    with pytest.raises(RecipeError, match="twice"):
        split_urls("ws://a:1,ws://a:1")
    assert address_name("ws://127.0.0.1:8000") == "127.0.0.1-8000"
    assert address_name("ws://[::1]:8000") == "--1-8000"
    assert [is_loopback(f"ws://{host}:1") for host in ("localhost", "127.0.0.2", "[::1]", "10.0.0.1")] == [
        True,
        True,
        True,
        False,
    ]


def test_a_recipe_may_stand_before_an_address() -> None:
    assert named_server("remote_openpi") is None
    assert named_server("ws://a:1") == (None, "ws://a:1")
    assert named_server("remote_openpi@ws://a:1,ws://b:2") == ("remote_openpi", "ws://a:1,ws://b:2")
