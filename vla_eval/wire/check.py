"""Does the server of a policy keep the protocol? Asked over the wire, with noise as observations.

This file runs with Python 3.8, numpy 1.22 and websockets 13, with files next to it: see `mikasa_vla_client`.
"""

from __future__ import annotations

import http.client
import re
from typing import Any, Callable, Mapping
from urllib.parse import urlsplit

import numpy as np

# Relative: the file is in two packages.
from .check_client import (
    CheckFailedError,
    Chunks,
    Episode,
    Facts,
    RefusedError,
    Server,
    committed,
    run_episodes,
    shown,
)
from .noise import PAIRS, SEEDS
from .numbers import CHUNKING_MODES, COMMITTED_ACTIONS_KEY, MEMORY

__all__ = ["CheckFailedError", "check_remote"]

PROTOCOL = "openpi+1"
IMAGE_SIZE_PX = 128  # of a camera whose size the server does not say
NO_CODEC_BYTE = b"\xc1"  # the one byte that msgpack never begins with
BY_SESSION = (
    "Keep the policy's memory by `session_id` (in mikasa_vla_client: in `session.memory`) and begin it in "
    "`reset`."
)
TRACEBACK = "Traceback (most recent call last)"

Report = Callable[[str], None]


def check_remote(
    url: str,
    *,
    api_key: str | None = None,
    timeout_seconds: float = 60.0,
    report: Report = lambda claim: None,
) -> list[str]:
    """Check that a server keeps the protocol, and that its sessions do not affect each other.

    `report` is called with each requirement that is met, as soon as that is known. Returned are all of them,
    in the order in which they were checked; of a server that does not announce this protocol, also what could
    not be tried.

    Raises:
        CheckFailedError: one is not met; the message says which, and what was found.
    """
    server = Server(url, api_key, timeout_seconds)
    met: list[str] = []
    said = server.first_message()
    is_ours = said.get("protocol") == PROTOCOL
    checks = [_healthz, _metadata, _chunks, _layouts, _seeds, _sessions, _resets, _memories, _joining]
    checks.append(_refusals)
    for check in checks if is_ours else [_plain]:
        for claim in check(server):
            met.append(claim)
            report(claim)
    return met


def _plain(server: Server) -> list[str]:
    return [
        "The server sends a map as its first message.",
        f"Not tried: inference. The server does not announce the protocol '{PROTOCOL}', so it does not say "
        f"which keys it reads. A recipe says it: `mikasa-vla check remote_openpi@{server.url}`.",
    ]


def _healthz(server: Server) -> list[str]:
    parts = urlsplit(server.url)
    kind = http.client.HTTPSConnection if parts.scheme == "wss" else http.client.HTTPConnection
    request = kind(parts.hostname or "", parts.port, timeout=server.timeout_seconds)
    try:
        request.request("GET", "/healthz")
        found = str(request.getresponse().status)
    except (OSError, UnicodeError, http.client.HTTPException) as exc:
        found = repr(exc)
    finally:
        request.close()
    server.expect(found == "200", "GET /healthz answers 200.", found)
    return ["GET /healthz answers 200."]


def _is_digest(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None


def _is_names(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and all(isinstance(name, str) for name in value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _is_camera(value: Any) -> bool:
    if not isinstance(value, dict) or not isinstance(value.get("key"), str):
        return False
    return all(value.get(side) is None or _is_count(value[side]) for side in ("height_px", "width_px"))


_FIELDS: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    "name": ("a text", lambda v: isinstance(v, str) and bool(v)),
    "weights_sha256": (
        "64 hexadecimal digits, or null without weights",
        lambda v: v is None or _is_digest(v),
    ),
    "chunk_size": ("a number ≥ 1", _is_count),
    "control_mode": ("a text", lambda v: isinstance(v, str) and bool(v)),
    "action_dims": ("a list of names", lambda v: _is_names(v) and len(v) > 0),
    "cameras": (
        "a map: camera -> {key, height_px, width_px}",
        lambda v: isinstance(v, dict) and all(_is_camera(camera) for camera in v.values()),
    ),
    "state_layouts": (
        "a map: layout -> list of names",
        lambda v: isinstance(v, dict) and all(_is_names(names) for names in v.values()),
    ),
    "prompt_key": ("a text", lambda v: isinstance(v, str) and bool(v)),
    "needs_every_frame": ("true or false", lambda v: isinstance(v, bool)),
    "batch_max": ("a number ≥ 1", _is_count),
    "supports": ("a list of names", _is_names),
}


def _metadata(server: Server) -> list[str]:
    said = server.first_message()
    for field, (expected, is_right) in _FIELDS.items():
        found = shown(said[field]) if field in said else "nothing"
        server.expect(field in said and is_right(said[field]), f"`{field}` is {expected}.", found)
    if said["state_layouts"]:
        has_key = isinstance(said.get("state_key"), str)
        server.expect(has_key, "`state_key` is a text.", shown(said.get("state_key")))
    mode = said.get("chunking_mode")
    is_known = mode is None or (isinstance(mode, str) and mode in CHUNKING_MODES)
    server.expect(is_known, "`chunking_mode` is rtc or prefix, or left out.", shown(mode))
    for feature in ("reset", "seed", *(["observe"] if said["needs_every_frame"] else [])):
        server.expect(feature in said["supports"], f"`supports` has '{feature}'.", shown(said["supports"]))
    server.facts = Facts(
        chunk_size=said["chunk_size"],
        n_dims=len(said["action_dims"]),
        cameras={
            camera["key"]: (camera.get("height_px") or IMAGE_SIZE_PX, camera.get("width_px") or IMAGE_SIZE_PX)
            for camera in said["cameras"].values()
        },
        state_key=said.get("state_key"),
        layouts=dict(said["state_layouts"]),
        prompt_key=said["prompt_key"],
        needs_every_frame=said["needs_every_frame"],
        batch_max=said["batch_max"],
        supports=said["supports"],
        joins=mode is not None,
    )
    return [f"The first message says what the policy reads and returns ({said['name']})."]


def _chunks(server: Server) -> list[str]:
    for seed in SEEDS:
        with server.connect() as connection:
            (server.alone[seed],) = run_episodes([Episode(server, connection, seed)])
    shape = (server.facts.chunk_size, server.facts.n_dims)
    return [f"Noise of the announced shapes gives finite float32 actions of shape {shape}."]


def _layouts(server: Server) -> list[str]:
    for layout in server.facts.layouts:
        with server.connect() as connection:
            episode = Episode(server, connection, 1)
            episode.begin()
            episode.ask(layout)
            episode.answer()
    return [f"It takes the state as `{layout}`." for layout in server.facts.layouts]


def _seeds(server: Server) -> list[str]:
    with server.connect() as connection:
        (again,) = run_episodes([Episode(server, connection, 1)])
    requirement = "The same seed and observations give the same actions in another session."
    advice = (
        "Draw random numbers from a generator that the episode's `seed` makes, and forget earlier episodes."
    )
    return [_expect_same(server, again, 1, requirement, advice)]


def _sessions(server: Server) -> list[str]:
    claims = []
    for n_connections, where in ((1, "on one connection"), (2, "on two connections")):
        requirement = f"Two sessions side by side {where} get what each gets alone."
        for pair in PAIRS:
            connections = [server.connect() for _ in range(n_connections)]
            episodes = [
                Episode(server, connections[0], pair[0], "a"),
                Episode(server, connections[-1], pair[1], "b"),
            ]
            try:
                for seed, chunks in zip(pair, run_episodes(episodes)):
                    _expect_same(server, chunks, seed, requirement, BY_SESSION)
            finally:
                for connection in connections:
                    connection.close()
        claims.append(requirement)
    return claims


def _resets(server: Server) -> list[str]:
    with server.connect() as connection:
        run_episodes([Episode(server, connection, 2)])
        (after,) = run_episodes([Episode(server, connection, 1)])
    return [_expect_same(server, after, 1, "`reset` forgets the session's earlier episode.", BY_SESSION)]


def _memories(server: Server) -> list[str]:
    """Continue an episode in another session, with the memory that it had."""
    if MEMORY not in server.facts.supports:
        return []
    moved = (
        "An episode continues with the memory that was read, in another session: its actions are the same."
    )
    for n_asked, n_asked_there in ((1, 0), (2, 1)):  # so that what is kept beside the memory is older
        with server.connect() as connection:
            first, second = (Episode(server, connection, 1, session_id=name) for name in "ab")
            first.begin()
            for _ in range(n_asked):
                first.ask()
                first.answer()
            second.begin()
            for _ in range(n_asked_there):
                second.ask()
                second.answer()
            second.continue_from(first)
            while len(second.chunks) < len(server.alone[1]):
                second.ask()
                second.answer()
        advice = "Let `get_memory` return all that is kept of the episode between two inferences."
        _expect_same(server, second.chunks, 1, moved, advice)
    return [moved]


def _joining(server: Server) -> list[str]:
    """Ask for a chunk that joins the one before, of which nothing, a part or all is yet to be executed."""
    if not server.facts.joins:
        return []
    joined = "A request may say what is committed; the answer is a chunk like any other."
    size = server.facts.chunk_size
    for n_left, n_frozen in ((0, 0), (max(size // 2, 1), 1), (size, 1)):
        with server.connect() as connection:
            episode = Episode(server, connection, 1)
            episode.begin()
            episode.ask()
            episode.answer()
            episode.ask(committed=committed(episode.chunks[-1][size - n_left :], n_frozen))
            episode.answer()
    return [joined]


def _bad_messages(facts: Facts) -> dict[str, Any]:
    """Return description -> a message that has to be refused."""
    good = facts.observation(1, 0)
    image = next(iter(facts.cameras), None)
    bad: dict[str, Any] = {
        "bytes that are not msgpack": NO_CODEC_BYTE * 8,
        "a text": "infer",
        "an endpoint that does not exist": {**good, "endpoint": "jump"},
        "an episode without an instruction": {k: v for k, v in good.items() if k != facts.prompt_key},
    }
    if MEMORY in facts.supports:
        begun = {**good, "endpoint": "memory/set"}
        bad["a memory for a session without an episode"] = {**begun, MEMORY: {}}
    if facts.joins:
        rows = np.zeros((facts.chunk_size + 1, facts.n_dims), dtype=np.float32)
        bad["more committed actions than a chunk has"] = {**good, **committed(rows, 0)}
        bad["more frozen actions than committed ones"] = {**good, **committed(rows[:1], 2)}
        bad["committed actions that are not numbers"] = {**good, **committed(rows[:1] * np.float32("nan"), 1)}
        bad["committed actions without how many are frozen"] = {**good, COMMITTED_ACTIONS_KEY: rows[:1]}
    if image is not None:
        bad["a missing image"] = {key: value for key, value in good.items() if key != image}
        bad["an image of another shape"] = {**good, image: good[image][:-1]}
        bad["an image of floating-point numbers"] = {**good, image: good[image] / np.float32(255)}
    if facts.state_key in good:
        bad["a state with a number too many"] = {
            **good,
            str(facts.state_key): np.zeros(max(map(len, facts.layouts.values())) + 1, dtype=np.float32),
        }
        for what, number in (("that is not a number", np.nan), ("that is infinite", np.inf)):
            bad["a state with a number " + what] = {
                **good,
                str(facts.state_key): good[facts.state_key] * number,
            }
    return bad


def _refusals(server: Server) -> list[str]:
    claims = []
    for name, message in _bad_messages(server.facts).items():
        with server.connect() as connection:
            connection.send(message)
            try:
                found = shown(connection.receive())
            except RefusedError as exc:
                found = ""
                requirement = "An error is one message, without a traceback."
                server.expect(TRACEBACK not in str(exc), requirement, str(exc)[:200])
            server.expect(not found, f"Refused with a text: {name}.", found)
        claims.append(f"Refused with a text: {name}.")
    with server.connect() as connection:
        (after,) = run_episodes([Episode(server, connection, 1)])
    requirement = "After refused messages the server answers as before."
    return [
        *claims,
        _expect_same(server, after, 1, requirement, "A refused message must not change anything."),
    ]


def _expect_same(server: Server, chunks: Chunks, seed: int, requirement: str, advice: str) -> str:
    """Return the requirement if the chunks are those of the seed's episode alone."""
    for index, (expected, found) in enumerate(zip(server.alone[seed], chunks)):
        if not np.array_equal(expected, found):
            most = float(np.abs(expected - found).max())
            difference = f"inference {index + 1} differs by up to {most:.3g}"
            raise server.failed(f"{requirement} Found: {difference}. {advice}")
    return requirement
