"""Sessions of a server: one episode each, with its slot, its row of a pass and its unread frames."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal  # Any: what a client sends

from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.serving.observations import PROMPT_WIRE_KEY, ObservationReader, RequestError, read_prompt
from vla_eval.strict.json_text import shown
from vla_eval.tasks.catalog import TASKS

MAX_UNREAD_FRAMES = 1024  # 100 MB of two cameras of 128 px
MAX_SESSIONS = 4096
MAX_SESSIONS_OF_CONNECTION = 1024  # as of `mikasa_vla_client`: a worker has one for each of its slots
MAX_SESSIONS_OF_ADDRESS = 3072  # of all connections of one machine: others always find room for 1024
MAX_DROPPED_NAMES = 4096  # of a connection, that are remembered for a message
MAX_TEXT = 200  # characters of an id
MAX_NUMBER = 2**63 - 1
UNKNOWN_HORIZON_STEPS = 1_000_000  # for a client that does not say how long its episode is
LONGEST_HORIZON_STEPS = max(task.horizon_steps for task in TASKS.values())

_Key = tuple[int, str | None]  # number of the connection, name within it

logger = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Session:
    """One client's episode."""

    connection: int
    address: str  # of the machine that the connection comes from
    name: str | None  # its id within the connection; None: the connection itself
    slot: int  # where the policy keeps what it remembers of it
    row: int  # its row of a pass
    used_at: float  # time of its last message, by the clock of the table
    episode: EpisodeStart | None = None  # what was begun last; None before
    was_reset: bool = False  # whether it was begun by a `reset`
    # frames that the policy has not been given yet
    frames: list[Observation] = field(default_factory=list)
    step: int | None = None  # the step of the newest frame; None before the first
    n_pending: int = 0  # requests that have no reply yet


class SessionTable:
    """All sessions of a server. Methods that take a request raise `RequestError` for what they refuse."""

    def __init__(
        self,
        reader: ObservationReader,
        *,
        reads: Literal["last", "every"],
        n_rows: int,
        task: str,
        forget: Callable[[int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._reader, self._reads, self._n_rows, self._task = reader, reads, n_rows, task
        self._forget, self._clock = forget, clock
        self._sessions: dict[_Key, Session] = {}
        # Connection -> names that were dropped and why, until their next reset.
        self._dropped: dict[int, dict[str | None, str]] = {}
        self._has_warned = False

    def __len__(self) -> int:
        return len(self._sessions)

    def session(self, connection: int, request: Mapping[str, Any], *, address: str) -> Session:
        """Return the session of a request from a machine with this address; a new one for a new id."""
        name = _text(request, "session_id")
        key = (connection, name)
        dropped = self._dropped.get(connection, {})
        if name in dropped and request.get("endpoint") != "reset":
            raise RequestError(
                f"session {shown(name)} was dropped, since {dropped[name]}: the policy has forgotten its "
                "episode. Begin a new one with 'reset'."
            )
        dropped.pop(name, None)
        found = self._sessions.get(key)
        if found is None:
            self._make_room(connection, address)
            slots = {session.slot for session in self._sessions.values()}
            rows = Counter(session.row for session in self._sessions.values())
            found = Session(
                connection=connection,
                address=address,
                name=name,
                slot=next(slot for slot in range(MAX_SESSIONS) if slot not in slots),
                row=min(range(self._n_rows), key=lambda row: (rows[row], row)),  # the emptiest
                used_at=self._clock(),
            )
            self._sessions[key] = found
        found.used_at = self._clock()
        return found

    def begin(self, session: Session, request: Mapping[str, Any]) -> EpisodeStart:
        """Begin an episode in a session; all that it had is forgotten."""
        _number(request, "step")  # of a reset, it is only repeated in the reply
        row = _number(request, "row", most=self._n_rows - 1)
        session.row = session.row if row is None else row
        start = EpisodeStart(
            slot=session.slot,
            task=_text(request, "task") or self._task,
            seed=_number(request, "seed") or 0,
            run=_number(request, "run") or 0,
            instruction=read_prompt(request),
            horizon_steps=_number(request, "horizon_steps") or UNKNOWN_HORIZON_STEPS,
            row=session.row,
        )
        session.episode, session.frames, session.step = start, [], None
        session.was_reset = request.get("endpoint") == "reset"
        return start

    def begins(self, session: Session, request: Mapping[str, Any]) -> bool:
        """Whether an `infer` begins an episode: openpi's client never sends a `reset`."""
        if session.episode is not None:
            is_same = request.get(PROMPT_WIRE_KEY) in (None, session.episode.instruction)
            if session.was_reset and not is_same:
                raise RequestError("another instruction in the middle of an episode. Send 'reset' first.")
            return not is_same
        step = _number(request, "step")
        if step:
            raise RequestError(
                f"step {step} of an episode that the server does not have: the session is new. Begin the "
                "episode again, with 'reset'."
            )
        return True

    def observe(self, session: Session, request: Mapping[str, Any]) -> None:
        """Keep a frame for the next inference, if the policy is given every frame."""
        step = self._next_step(session, request)
        if self._reads == "last":
            return
        if len(session.frames) >= MAX_UNREAD_FRAMES:
            raise RequestError(f"expected at most {MAX_UNREAD_FRAMES} frames between two inferences.")
        session.frames.append(self._reader.read(request, step=step))

    def window(self, session: Session, request: Mapping[str, Any]) -> ObservationWindow:
        """Return what the policy is given for an inference: the unread frames, and the one of the request."""
        committed = self._reader.read_committed(request)
        newest = self._reader.read(request, step=self._next_step(session, request))
        frames, session.frames = (*session.frames, newest), []
        return ObservationWindow(slot=session.slot, frames=frames, committed=committed)

    def drop_connection(self, connection: int) -> None:
        """Drop the sessions of a connection that has ended."""
        self._drop([key for key in self._sessions if key[0] == connection], "its connection has ended")
        self._dropped.pop(connection, None)

    def drop_idle(self, seconds: float) -> None:
        """Drop the sessions without a message for so long and without a request under way."""
        now = self._clock()
        idle = [
            key
            for key, session in self._sessions.items()
            if not session.n_pending and now - session.used_at > seconds
        ]
        self._drop(idle, "no message came for too long (--idle-seconds)")

    def _make_room(self, connection: int, address: str) -> None:
        """Drop the longest silent idle session of the same connection if one more would be too many."""
        own = [key for key in self._sessions if key[0] == connection]
        n_of_address = sum(session.address == address for session in self._sessions.values())
        for n_sessions, limit, whose in (
            (len(own), MAX_SESSIONS_OF_CONNECTION, "of a connection"),
            (n_of_address, MAX_SESSIONS_OF_ADDRESS, "of a machine"),
            (len(self._sessions), MAX_SESSIONS, "of a server"),
        ):
            if n_sessions >= limit:
                idle = [key for key in own if not self._sessions[key].n_pending]
                if not idle:
                    raise RequestError(f"expected at most {limit} sessions {whose} at a time.")
                oldest = min(idle, key=lambda key: self._sessions[key].used_at)
                self._drop([oldest], f"it was the idlest of more than {limit} sessions {whose}")
                return

    def _drop(self, keys: Iterable[_Key], reason: str) -> None:
        for connection, name in keys:
            self._forget(self._sessions.pop((connection, name)).slot)
            dropped = self._dropped.setdefault(connection, {})
            dropped[name] = reason
            if len(dropped) > MAX_DROPPED_NAMES:
                del dropped[next(iter(dropped))]  # the one that was dropped first

    def _next_step(self, session: Session, request: Mapping[str, Any]) -> int:
        """Return the step of a frame: as the client says, or else the number of frames so far."""
        given = _number(request, "step")
        expected = 0 if session.step is None else session.step + 1
        if given is not None and given < expected:
            raise RequestError(f"step {given} after step {session.step}: frames of an episode come in order.")
        session.step = expected if given is None else given
        if self._reads == "every" and not self._has_warned:
            self._warn_if_never_reset(session, session.step)
        return session.step

    def _warn_if_never_reset(self, session: Session, step: int) -> None:
        """Warn, once, of an episode with more frames than any: its memory is that of several episodes."""
        assert session.episode is not None
        said = session.episode.horizon_steps
        longest = LONGEST_HORIZON_STEPS if said == UNKNOWN_HORIZON_STEPS else said
        if step <= longest:  # an episode of H steps has H + 1 frames
            return
        self._has_warned = True
        logger.warning(
            "connection %d from %s, session %s: step %d of one episode, expected at most %d (%s). This "
            "policy remembers all frames since the last 'reset'. A client has to send 'reset' before each "
            "episode, or to open a connection for each; 'horizon_steps' of a 'reset' announces a longer one. "
            "This is logged once.",
            session.connection,
            session.address,
            shown(session.name),
            step,
            longest,
            "its 'horizon_steps'" if longest == said else "the longest task",
        )


def _text(request: Mapping[str, Any], key: str) -> str | None:
    value = request.get(key)
    if value is not None and not (isinstance(value, str) and 0 < len(value) <= MAX_TEXT):
        raise RequestError(f"'{key}': expected text of at most {MAX_TEXT} characters, found {shown(value)}.")
    return value


def _number(request: Mapping[str, Any], key: str, *, most: int = MAX_NUMBER) -> int | None:
    value = request.get(key)
    if value is None:
        return None
    number = value.item() if hasattr(value, "item") and getattr(value, "ndim", None) == 0 else value
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= most:
        raise RequestError(f"'{key}': expected a number from 0 to {most}, found {shown(value)}.")
    return number
