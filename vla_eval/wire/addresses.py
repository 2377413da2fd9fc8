"""Addresses of policy servers: `ws://HOST:PORT`, several with commas. Knows nothing of connections."""

import re
from typing import NamedTuple
from urllib.parse import urlsplit

from vla_eval.errors import MAX_SHOWN, RecipeError

SCHEMES = ("ws", "wss")
LOOPBACK = ("localhost", "::1")
_URL = re.compile(r"(?P<recipe>[^@]*@)?(?P<urls>wss?://.*)", re.DOTALL)


class NamedServer(NamedTuple):
    """What a user wrote for a policy behind a socket: a recipe if one is before an `@`, and the URLs."""

    recipe: str | None
    urls: str


def named_server(name: str) -> NamedServer | None:
    """Return recipe and address of `ws://…` or `RECIPE@ws://…`; None if the name is not an address."""
    match = _URL.fullmatch(name)
    if match is None:
        return None
    recipe = match["recipe"]
    return NamedServer(recipe[:-1] if recipe else None, match["urls"])


def split_urls(text: str) -> tuple[str, ...]:
    """Return the addresses of a list with commas; a `RecipeError` for one that is wrong or there twice."""
    urls = tuple(url.strip().rstrip("/") for url in text.split(","))
    for url in urls:
        try:
            parts = urlsplit(url)
            is_address = parts.scheme in SCHEMES and bool(parts.hostname) and parts.port != 0
            has_user = parts.username is not None
        except ValueError:  # a port that is not a number, or brackets that do not close
            is_address = has_user = False
        if not is_address or has_user or not url.isprintable() or " " in url:
            raise RecipeError(
                f"'{url:.{MAX_SHOWN}}' is not the address of a policy server: expected ws://HOST:PORT or "
                f"wss://HOST:PORT, several with commas between them."
            )
        if urls.count(url) > 1:
            raise RecipeError(f"the server '{url:.{MAX_SHOWN}}' is named twice.")
    return urls


def address_name(url: str) -> str:
    """Return `HOST-PORT`, without characters that a file's name cannot have."""
    parts = urlsplit(url)
    port = "" if parts.port is None else f"-{parts.port}"
    return re.sub(r"[^A-Za-z0-9._-]", "-", f"{parts.hostname}{port}")


def is_loopback(url: str) -> bool:
    """Whether the server is on this machine."""
    host = urlsplit(url).hostname or ""
    return host in LOOPBACK or host.startswith("127.")
