"""Assemble a worker's messages to its parent without ever waiting for the rest of a message.

The policy runs in the worker's process and may write into the same socket. Anything else is refused by
its first bytes, so that a length that is not ours is neither waited for nor reserved. Unpickling trusts the
worker, whose code has the rights of the user in any case.
"""

import os
import pickle
import struct
from multiprocessing.connection import Connection

from vla_eval.errors import VlaEvalError

MAGIC = b"mikasa-vla"
HEADER = struct.Struct(f">{len(MAGIC)}sQ")
MAX_MESSAGE_BYTES = 1 << 26  # an attempt with all its actions has less than a hundredth of it
READ_BYTES = 1 << 16
MAX_READS = 64  # at once, so that a worker that writes without end does not keep the parent from the others


class BrokenMessageError(VlaEvalError):
    """A worker has sent something that is not a message."""


def send_message(connection: Connection, message: object) -> None:
    """Send an object to the `Inbox` at the other end."""
    payload = pickle.dumps(message)
    if len(payload) > MAX_MESSAGE_BYTES:
        raise BrokenMessageError(
            f"expected an answer of at most {MAX_MESSAGE_BYTES:,} bytes, found one of {len(payload):,} bytes."
        )
    data = memoryview(HEADER.pack(MAGIC, len(payload)) + payload)
    while data:
        data = data[os.write(connection.fileno(), data) :]


class Inbox:
    """The parent's end of a worker's connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._data = bytearray()

    def read(self) -> list[object]:
        """Return the messages that have come since the last call; errors are those of `Service.read`."""
        messages: list[object] = []
        for _ in range(MAX_READS):
            if not self._connection.poll():
                break
            received = os.read(self._connection.fileno(), READ_BYTES)
            if not received and not messages:
                raise EOFError
            if not received:  # once more with the next call
                break
            self._data += received
            while (payload := self._next_payload()) is not None:
                messages.append(_unpickled(payload))
        return messages

    def _next_payload(self) -> bytes | None:
        """Take one whole message off what has come, if there is one."""
        begun = bytes(self._data[: len(MAGIC)])
        if begun != MAGIC[: len(begun)]:
            raise BrokenMessageError(f"expected an answer, found {bytes(self._data[:40])!r}")
        if len(self._data) < HEADER.size:
            return None
        _, size = HEADER.unpack_from(self._data)
        if size > MAX_MESSAGE_BYTES:
            raise BrokenMessageError(
                f"expected an answer of at most {MAX_MESSAGE_BYTES:,} bytes, found one of {size:,} bytes"
            )
        if len(self._data) < HEADER.size + size:
            return None
        payload = bytes(self._data[HEADER.size : HEADER.size + size])
        del self._data[: HEADER.size + size]
        return payload


def _unpickled(payload: bytes) -> object:
    try:
        return pickle.loads(payload)
    except Exception as exc:  # a forged pickle may raise anything
        raise BrokenMessageError(
            f"expected an answer, found what cannot be unpickled ({exc!r:.200})"
        ) from exc
