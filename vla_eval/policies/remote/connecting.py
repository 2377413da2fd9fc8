"""Connect to one of several servers of a policy, in the words that it understands."""

import os
from collections.abc import Sequence
from typing import NamedTuple
from urllib.parse import urlsplit

from vla_eval.policies.remote.settings import RemoteSettings
from vla_eval.policies.remote.vla_eval_dialect import VlaEvalClient
from vla_eval.wire.client import OpenpiClient, PolicyClient
from vla_eval.wire.connection import Connection
from vla_eval.workers.start import NEAR_VARIABLE


class Connected(NamedTuple):
    """A server that was chosen, and the connection to it."""

    url: str
    client: PolicyClient

    def another(self, settings: RemoteSettings) -> PolicyClient:
        """Return one more connection to the same server."""
        return _connect(self.url, settings, connect_seconds=0.0)


def connect_client(urls: Sequence[str], settings: RemoteSettings, *, connect_seconds: float) -> Connected:
    """Connect to the server with the fewest sessions, of this machine if possible; all are the same."""
    near = [url for url in urls if urlsplit(url).hostname == os.environ.get(NEAR_VARIABLE)]
    connected = connect_all(near or urls, settings, connect_seconds=connect_seconds)
    n_sessions = [one.client.metadata.n_sessions or 0 for one in connected]
    free = [one for one, n in zip(connected, n_sessions, strict=True) if n == min(n_sessions)]
    chosen = free[os.getpid() % len(free)]
    for one in connected:
        if one is not chosen:
            one.client.close()
    return chosen


def connect_all(urls: Sequence[str], settings: RemoteSettings, *, connect_seconds: float) -> list[Connected]:
    """Connect to each server, or to none; see `connect_client`."""
    connected: list[Connected] = []
    try:
        for url in urls:
            connected.append(Connected(url, _connect(url, settings, connect_seconds=connect_seconds)))
    except BaseException:
        for one in connected:
            one.client.close()
        raise
    return connected


def _connect(url: str, settings: RemoteSettings, *, connect_seconds: float) -> PolicyClient:
    is_openpi = settings.dialect == "openpi"
    connection = Connection(
        url,
        timeout_seconds=settings.timeout_seconds,
        connect_seconds=connect_seconds,
        api_key=settings.api_key,
        text_markers=not is_openpi,
    )
    return OpenpiClient(connection) if is_openpi else VlaEvalClient(connection, settings)
