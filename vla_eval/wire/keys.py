"""The API key in the header `Authorization: Api-Key KEY`: written by clients, compared by servers.

On the wire a key is its UTF-8, whatever the version of websockets makes of text. Clients of others write
ISO 8859-1, so that is taken as well.

This file runs with Python 3.8 and websockets 13, and imports nothing else: `mikasa_vla_client` ships it, too.
"""

from __future__ import annotations

import hmac
from http import HTTPStatus
from typing import Sequence

from websockets.datastructures import Headers

HEADER, SCHEME = "Authorization", "Api-Key"
MAX_KEY_BYTES = 4096  # websockets reads lines of headers of at most 8192 bytes
IS_LATIN_1 = b"\xc3" not in Headers({"X": "\xe9"}).serialize()
"""Whether this version of websockets writes headers in ISO 8859-1; former ones wrote UTF-8."""


def key_problem(key: str) -> str | None:
    """Return why a text cannot be a key, without repeating it; None if it can."""
    if not key.isprintable() or key != key.strip():  # a header may not hold the one, and loses the other
        return "expected printable characters, and no space at either end"
    if not 0 < len(key.encode("utf-8")) <= MAX_KEY_BYTES:
        return f"expected 1 to {MAX_KEY_BYTES} bytes, found {len(key.encode('utf-8'))}"
    return None


def key_headers(key: str | None) -> dict[str, str]:
    """Return the headers that a client sends; none without a key, which `key_problem` has looked at."""
    if key is None:
        return {}
    return {HEADER: f"{SCHEME} {key.encode('utf-8').decode('latin-1') if IS_LATIN_1 else key}"}


def refused(given: Sequence[str], key: str | None) -> HTTPStatus | None:
    """Return the status with which a client of these headers `Authorization` is refused; None: let in."""
    if len(given) > 1:
        return HTTPStatus.BAD_REQUEST
    if key is None:
        return None
    found = _on_the_wire(given[0]) if given else b""
    # Both are compared: which of them it is must not be seen from the time.
    matches = [hmac.compare_digest(found, f"{SCHEME} {key}".encode(code)) for code in _codes(key)]
    return None if any(matches) else HTTPStatus.UNAUTHORIZED


def explanation(status: HTTPStatus) -> str:
    """Return the text for a refused client."""
    if status is HTTPStatus.BAD_REQUEST:
        return f"expected one header '{HEADER}', found several\n"
    return f"expected the header '{HEADER}: {SCHEME} KEY'\n"


def _codes(key: str) -> Sequence[str]:
    return ("utf-8", "latin-1") if all(ord(letter) < 256 for letter in key) else ("utf-8",)


def _on_the_wire(value: str) -> bytes:
    """Return the bytes of a header that websockets has decoded, as ISO 8859-1 or as ASCII with escapes."""
    try:
        return value.encode("latin-1")
    except UnicodeEncodeError:
        return value.encode("utf-8", "surrogateescape")
