"""What a client says to a policy server, in openpi's words, and what it takes for an answer.

Each question of a session gets one answer before the next one is asked. On a server of this wire, sessions
share a connection, and answers come in the order of completion. On any other, a session is a connection.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol  # Any: a message may hold anything

from vla_eval.core import EpisodeStart, MemoryArrays
from vla_eval.strict.json_text import shown
from vla_eval.wire.connection import Connection
from vla_eval.wire.metadata import ServerMetadata
from vla_eval.wire.numbers import GET_MEMORY, MEMORY, SET_MEMORY

READING_KEY = "sentence_read"
"""Of an answer of this wire: what the policy has read of the sentence, where that is new."""
RESET_STATUS = "reset"
RESET_TEXT = "reset successful"  # of RoboArena's servers


class PolicyClient(Protocol):
    """A connection to a server, in the words that it understands."""

    @property
    def metadata(self) -> ServerMetadata:
        """Metadata of the server."""

    @property
    def shares_connection(self) -> bool:
        """Whether several sessions may use this client at the same time."""

    def ask_reset(self, session: str, start: EpisodeStart) -> None:
        """Begin an episode in a session."""

    def take_reset(self, session: str) -> None:
        """Wait until the episode has begun."""

    def observe(self, session: str, request: Mapping[str, Any], *, step: int) -> None:
        """Send a frame before the one of the next inference; nobody waits for it."""

    def ask_infer(self, session: str, request: Mapping[str, Any], *, step: int) -> None:
        """Send the newest frame, and ask for actions."""

    def take_infer(self, session: str) -> Any:
        """Return the actions of the answer, unchecked."""

    def take_reading(self, session: str) -> Any:
        """Return what the last answer said of how the sentence was read, unchecked; None: nothing."""

    def ask_memory(self, session: str, memory: MemoryArrays | None) -> Any:
        """Replace the memory of a session; None: return it, unchecked."""

    def close(self) -> None:
        """Close the connection."""


class _Question(NamedTuple):
    """What an answer is waited for: which endpoint, at which control step."""

    endpoint: str
    step: int


class OpenpiClient:
    """openpi's words; sessions, resets and single frames only where the server announces them."""

    def __init__(self, connection: Connection) -> None:
        """Read the server's metadata, or raise a `RemotePolicyError`."""
        self._connection = connection
        try:
            self._metadata = ServerMetadata.from_wire(connection.receive(), where=connection.url)
        except BaseException:
            connection.close()
            raise
        self._asked: dict[str, _Question] = {}
        self._arrived: dict[str, dict[str, Any]] = {}
        self._episodes: dict[str, str] = {}
        self._readings: dict[str, Any] = {}

    @property
    def metadata(self) -> ServerMetadata:
        """Metadata of the server."""
        return self._metadata

    @property
    def shares_connection(self) -> bool:
        """Whether answers name their session."""
        return self._metadata.is_ours

    def ask_reset(self, session: str, start: EpisodeStart) -> None:
        """Begin an episode in a session; a server without resets gets nothing."""
        # A session may have several episodes of one seed, of different runs or tasks.
        self._episodes[session] = f"{start.task}/{start.run}/{start.seed}"
        metadata = self._metadata
        if not metadata.takes_reset:
            return
        fields: dict[str, Any] = {"prompt": start.instruction}
        if metadata.is_ours:
            offered = {"seed": start.seed, "row": start.row}
            fields |= {"task": start.task, "run": start.run, "horizon_steps": start.horizon_steps}
            fields |= {name: value for name, value in offered.items() if name in metadata.supports}
        self._asked[session] = _Question("reset", 0)
        self._connection.send({**fields, **self._address(session, "reset", step=0)})

    def take_reset(self, session: str) -> None:
        """Wait until the episode has begun; errors are those of `Connection.receive`."""
        if not self._metadata.takes_reset:
            return
        answer = self._answer(session)
        status = answer.get("status")
        if self._metadata.is_ours and not (isinstance(status, str) and status == RESET_STATUS):
            raise self._connection.refuse(f"expected the status '{RESET_STATUS}', found {shown(answer)}")

    def observe(self, session: str, request: Mapping[str, Any], *, step: int) -> None:
        """Send a frame before the one of the next inference; nobody waits for it."""
        self._connection.send({**request, **self._address(session, "observe", step=step)})

    def ask_infer(self, session: str, request: Mapping[str, Any], *, step: int) -> None:
        """Send the newest frame, and ask for actions."""
        self._asked[session] = _Question("infer", step)
        self._connection.send({**request, **self._address(session, "infer", step=step)})

    def take_infer(self, session: str) -> Any:
        """Return the actions of the answer, unchecked; errors are those of `Connection.receive`."""
        answer = self._answer(session)
        if "actions" not in answer:
            error = answer.get("message", answer.get("error"))
            raise self._connection.refuse(
                f"expected a map with 'actions', found {shown(error) if error else shown(sorted(answer))}"
            )
        if READING_KEY in answer:
            self._readings[session] = answer[READING_KEY]
        return answer["actions"]

    def take_reading(self, session: str) -> Any:
        """Return what a server of this wire reported on the sentence, unchecked; None: nothing new."""
        return self._readings.pop(session, None) if self._metadata.is_ours else None

    def ask_memory(self, session: str, memory: MemoryArrays | None) -> Any:
        """Replace the memory of a session; None: return it, unchecked."""
        endpoint = GET_MEMORY if memory is None else SET_MEMORY
        if MEMORY not in self._metadata.supports:
            raise self._connection.refuse(f"'{endpoint}': expected a server that supports '{MEMORY}'")
        given = {} if memory is None else {MEMORY: dict(memory)}
        self._asked[session] = _Question(endpoint, 0)
        self._connection.send({**given, **self._address(session, endpoint, step=0)})
        answer = self._answer(session)
        status = answer.get("status")
        if not (isinstance(status, str) and status == endpoint):
            raise self._connection.refuse(f"expected the status '{endpoint}', found {shown(answer)}")
        return answer.get(MEMORY)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _address(self, session: str, endpoint: str, *, step: int) -> dict[str, Any]:
        """Return what says for whom a message is; nothing for a server that knows no sessions."""
        if not self._metadata.takes_sessions:
            return {}
        address: dict[str, Any] = {"endpoint": endpoint, "session_id": session}
        if self._metadata.is_ours:
            address |= {"episode_id": self._episodes[session], "step": step}
        return address

    def _answer(self, session: str) -> dict[str, Any]:
        """Return the answer for a session; others that come before it are kept for theirs."""
        while session not in self._arrived:
            answer = self._receive(self._asked[session])
            owner = answer.get("session_id", None if self.shares_connection else session)
            if not isinstance(owner, str) or owner not in self._asked or owner in self._arrived:
                raise self._connection.refuse(
                    f"expected the session {shown(session)}, found {shown(owner)}, which asked nothing"
                )
            self._arrived[owner] = answer
        question, answer = self._asked.pop(session), self._arrived.pop(session)
        step = answer.get("step", question.step if question.endpoint == "reset" else None)
        # Anything may stand there: an array would be compared number by number.
        if self.shares_connection and not (isinstance(step, int) and step == question.step):
            raise self._connection.refuse(
                f"expected the answer for step {question.step}, found {shown(step)}"
            )
        return answer

    def _receive(self, question: _Question) -> dict[str, Any]:
        is_reset = question.endpoint == "reset"
        message = self._connection.receive(accept_text=(RESET_TEXT,) if is_reset else ())
        if isinstance(message, str) and message == RESET_TEXT:
            return {"status": RESET_STATUS}
        if isinstance(message, dict):
            return message
        if self.shares_connection or is_reset:
            raise self._connection.refuse(f"expected a map, found {shown(message)}")
        return {"actions": message}  # some servers send the bare array
