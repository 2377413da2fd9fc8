"""The API key: at both servers, from both clients and from others; headers that are none."""

import contextlib
import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.sync.client import connect

from tests.mikasa_vla_client.serving import client as plugin
from tests.mikasa_vla_client.serving import served
from tests.serving.served_policies import CountingPolicy, serving
from vla_eval.errors import RemoteConnectionError
from vla_eval.serving.server import ServeError, ServerOptions
from vla_eval.wire import keys
from vla_eval.wire.check_client import CheckFailedError, Server
from vla_eval.wire.codec import unpackb
from vla_eval.wire.connection import Connection
from vla_eval.wire.keys import MAX_KEY_BYTES, key_headers

SPEC = plugin.PolicySpec(name="plain", chunk_size=2)
KEYS = (
    "secret",
    "a b",
    "sécret",
    "clé£¥",
    "ключ",
    "鍵",
    "🔑",
    "x" * MAX_KEY_BYTES,
    "é" * (MAX_KEY_BYTES // 2),
)
BAD_KEYS = (
    "",
    " ",
    "a ",
    " a",
    "a\n",
    "a\r\nX: y",
    "a\0b",
    "a\x1b[0m",
    "\x7f",
    "\x85",
    "\ud800",
    "x" * (MAX_KEY_BYTES + 1),
)


@contextlib.contextmanager
def server(kind: str, key: str | None) -> Iterator[str]:
    if kind == "ours":
        with serving(CountingPolicy(), api_key=key) as running:
            yield running.url
    else:
        with served(lambda _: np.zeros((2, 7)), SPEC, api_key=key) as url:
            yield url


def status(url: str, *headers: bytes) -> int | None:
    """Return the answer to a handshake with these lines, as they are; None: the connection is closed."""
    parts = urlsplit(url)
    lines = [
        b"GET / HTTP/1.1",
        b"Host: " + parts.netloc.encode(),
        b"Upgrade: websocket",
        b"Connection: Upgrade",
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        b"Sec-WebSocket-Version: 13",
        *headers,
    ]
    with socket.create_connection((parts.hostname, parts.port), timeout=10) as raw:
        with contextlib.suppress(ConnectionError):  # a server may close before it has read all
            raw.sendall(b"\r\n".join(lines) + b"\r\n\r\n")
        try:
            answer = raw.recv(64)
        except ConnectionError:
            return None
        return int(answer.split()[1]) if answer else None


def authorization(key: bytes) -> bytes:
    return b"Authorization: Api-Key " + key


@pytest.mark.parametrize("kind", ["ours", "the plug-in's"])
class TestServers:
    @pytest.mark.parametrize("key", KEYS)
    def test_a_key_of_any_letters_lets_its_clients_in_and_no_other(self, kind: str, key: str) -> None:
        with server(kind, key) as url:
            Connection(url, timeout_seconds=10, api_key=key).close()
            Server(url, key, 10).connect().close()
            with connect(url, additional_headers=key_headers(key)) as socket_:
                assert "name" in unpackb(socket_.recv(timeout=10))
            for wrong in (None, key[1:].strip() or "y", key + "x" if len(key) < 9 else "y", "é", "ключи"):
                with pytest.raises(RemoteConnectionError, match="HTTP 401"):
                    Connection(url, timeout_seconds=10, api_key=wrong)

    def test_a_client_may_write_the_key_in_utf_8_or_in_latin_1(self, kind: str) -> None:
        with server(kind, "sécret") as url:
            assert status(url, authorization("sécret".encode())) == 101
            assert status(url, authorization("sécret".encode("latin-1"))) == 101
            assert status(url, authorization(b"s\xc3cret")) == 401
            assert status(url, authorization(b"s?cret")) == 401

    @pytest.mark.parametrize("key", [None, "secret"])
    def test_several_headers_are_a_bad_request(self, kind: str, key: str | None) -> None:
        right = authorization(b"secret")
        with server(kind, key) as url:
            for pair in (
                [right, right],
                [right, b"authorization: x"],
                [b"Authorization:", right],
                [right] * 50,
            ):
                assert status(url, *pair) == 400
            assert status(url, right) == 101

    def test_headers_that_are_none_are_refused_and_never_an_internal_error(self, kind: str) -> None:
        with server(kind, "secret") as url:
            for value, expected in {
                b"": 401,
                b" ": 401,
                b"secret": 401,
                b"Api-Key": 401,
                b"Api-Key ": 401,
                b"Api-Key  secret": 401,
                b"Api-Key secret x": 401,
                b"Bearer secret": 401,
                b"Basic c2VjcmV0": 401,
                b"Api-Key \xff\xfe": 401,
                b"Api-Key \xed\xa0\x80": 401,
                b"Api-Key secret\0": None,
                b"Api-Key sec\x1bret": None,
                b"Api-Key " + b"x" * 8_000: 401,
            }.items():
                assert status(url, b"Authorization: " + value) == expected, value[:40]
            many = [b"X-%d: y" % n for n in range(500)]
            for headers in ([authorization(b"x" * 100_000)], [*many, authorization(b"secret")]):
                assert status(url, *headers) in (None, 400, 413, 431)
            assert status(url, authorization(b"secret")) == 101  # it still serves


@pytest.mark.parametrize("key", BAD_KEYS)
def test_what_no_header_can_hold_is_refused_as_a_key_and_not_repeated(key: str) -> None:
    messages = []
    with pytest.raises(ServeError) as ours:
        ServerOptions(api_key=key)
    with pytest.raises(plugin.SpecError) as theirs:
        plugin.PolicyServer(lambda _: None, SPEC, port=0, api_key=key)
    with pytest.raises(RemoteConnectionError) as sent:
        Connection("ws://127.0.0.1:1", timeout_seconds=1, api_key=key)
    with pytest.raises(CheckFailedError) as checked:
        Server("ws://127.0.0.1:1", key, 1)
    for error in (ours, theirs, sent, checked):
        messages.append(str(error.value))
    assert all("expected" in message and len(message) < 300 and message.isprintable() for message in messages)


@pytest.mark.parametrize("key", [key for key in KEYS if len(key) < 9])
def test_with_any_version_of_websockets_a_key_is_its_utf_8(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Version 17 writes and reads ISO 8859-1; 13 wrote UTF-8 and read ASCII with escapes.
    wire = b"Api-Key " + key.encode()
    monkeypatch.setattr(keys, "IS_LATIN_1", True)
    assert key_headers(key)["Authorization"].encode("latin-1") == wire
    monkeypatch.setattr(keys, "IS_LATIN_1", False)
    assert key_headers(key)["Authorization"].encode("utf-8") == wire
    for read in (wire.decode("latin-1"), wire.decode("ascii", "surrogateescape")):
        assert keys.refused([read], key) is None
        assert keys.refused([read], key + "y") == 401
