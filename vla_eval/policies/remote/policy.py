"""The adapter `remote`: all requests of an inference are sent before the first answer is awaited."""

import os
import secrets
from collections.abc import Mapping, Sequence
from typing import Any  # Any: what a recipe holds, and what a server sends

import numpy as np

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.files import digest_of
from vla_eval.core import ActionChunk, EpisodeStart, MemoryArrays, ObservationWindow
from vla_eval.errors import RemoteChangedError, RemoteReplyError, SpecMismatchError
from vla_eval.models.shared.sentence_reading import SentenceReading, from_wire
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.remote.actions import as_rows, converted
from vla_eval.policies.remote.connecting import connect_client
from vla_eval.policies.remote.fit import Fit, fit
from vla_eval.policies.remote.settings import RemoteSettings, remote_settings
from vla_eval.specs import ActionSpec, PolicySpec
from vla_eval.wire.addresses import split_urls
from vla_eval.wire.client import PolicyClient
from vla_eval.wire.metadata import ServerMetadata
from vla_eval.wire.numbers import COMMITTED_ACTIONS_KEY, COMMITTED_FROZEN_KEY, MEMORY, memory_problem

SESSION_BYTES = 8


class RemotePolicy:
    """Asks a server for chunks; a session of the server per slot."""

    def __init__(
        self,
        *,
        spec: PolicySpec,
        clients: Mapping[int, PolicyClient],
        fit: Fit,
        settings: RemoteSettings,
        action: ActionSpec,
    ) -> None:
        """Keep the connections by slot; the same one for all where the server can distinguish them."""
        self.spec = spec
        self._clients = clients
        self._fit = fit
        self._settings = settings
        self._action = action
        # Names nothing but a session: no result depends on it.
        prefix = f"{os.getpid()}-{secrets.token_hex(SESSION_BYTES)}"
        self._sessions = {slot: f"{prefix}-{slot}" for slot in clients}
        self._instructions: dict[int, str] = {}
        self.readings: dict[str, SentenceReading] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin an episode in the session of each slot."""
        for start in episodes:
            self._instructions[start.slot] = start.instruction
            self._clients[start.slot].ask_reset(self._sessions[start.slot], start)
        for start in episodes:
            self._clients[start.slot].take_reset(self._sessions[start.slot])

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Ask for one chunk; see `act_batch`."""
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Ask for the chunks of several episodes; the order of the answers is that of the windows."""
        for window in windows:
            client, session = self._clients[window.slot], self._sessions[window.slot]
            *earlier, last = window.frames
            instruction = self._instructions[window.slot]
            for frame in earlier:
                client.observe(session, self._fit.request(frame, instruction), step=frame.step)
            request = self._fit.request(last, instruction)
            if window.committed is not None and len(window.committed.actions):
                request[COMMITTED_ACTIONS_KEY] = window.committed.actions
                request[COMMITTED_FROZEN_KEY] = window.committed.n_frozen
            client.ask_infer(session, request, step=last.step)
        return [self._answer(window.slot) for window in windows]

    def get_memory(self, slot: int) -> MemoryArrays:
        """Return what the server's policy keeps of a slot's episode."""
        memory = self._clients[slot].ask_memory(self._sessions[slot], None)
        problem = memory_problem(memory)
        if problem is not None:
            raise RemoteReplyError(f"policy '{self.spec.name}': the server's '{MEMORY}': {problem}.")
        return {name: np.array(part) for name, part in memory.items()}

    def set_memory(self, slot: int, memory: MemoryArrays) -> None:
        """Put a memory in place of that of a slot's episode."""
        problem = memory_problem(memory)
        if problem is not None:
            raise SpecMismatchError(f"policy '{self.spec.name}', set_memory: {problem}.")
        self._clients[slot].ask_memory(self._sessions[slot], memory)

    def close(self) -> None:
        """Close the connections."""
        for client in {id(client): client for client in self._clients.values()}.values():
            client.close()

    def _answer(self, slot: int) -> ActionChunk:
        client, session, sentence = self._clients[slot], self._sessions[slot], self._instructions[slot]
        chunk = self._chunk(client.take_infer(session))
        said = client.take_reading(session)
        if said is not None and sentence not in self.readings:
            self.readings[sentence] = from_wire(sentence, said, where=f"policy '{self.spec.name}'")
        return chunk

    def _chunk(self, actions: Any) -> ActionChunk:
        rows = as_rows(actions)
        shape = (self.spec.chunk_size, len(self._action.dims))
        is_sound = isinstance(rows, np.ndarray) and rows.shape == shape and rows.dtype == np.float32
        if self._settings.actions is not None and is_sound and np.isfinite(rows).all():
            rows = converted(rows, self._settings.actions, self._action)
        return ActionChunk(actions=rows)  # the loop refuses what is not sound


def make_remote(
    context: PolicyContext, *, url: str, identity_sha256: str | None = None, **args: Any
) -> RemotePolicy:
    """Connect to a policy server (of several, with commas, the one with the fewest sessions)."""
    where = f"policy '{context.name}'"
    settings = remote_settings({"url": url, **args}, where=where)
    client = connect_client(split_urls(url), settings, connect_seconds=settings.connect_seconds)
    clients = {0: client.client}
    try:
        metadata, where = client.client.metadata, f"{where}, {client.url}"
        if identity_sha256 not in (None, digest_of(metadata.identity())):
            raise RemoteChangedError(
                f"{where}: the server is not what it was when the run was planned: other weights, another "
                f"policy or other versions. Start the former one again, or use another --out for the new one."
            )
        fitted = fit(settings, metadata, context.env, where=where)
        can_observe = client.client.shares_connection and "observe" in metadata.supports
        if fitted.reads == "every" and context.chunking.n_action_steps > 1 and not can_observe:
            raise SpecMismatchError(
                f"{where}: the policy must see each control step, and the server takes no frames between "
                f"inferences. Use --n-action-steps 1."
            )
        _check_mode(context.chunking, metadata, where=where)
        for slot in range(1, context.n_slots):
            shared = client.client.shares_connection
            clients[slot] = client.client if shared else client.another(settings)
    except BaseException:
        for one in clients.values():
            one.close()
        raise
    spec = PolicySpec(
        name=context.name,
        reads=fitted.reads,
        cameras=tuple(fitted.cameras),
        states=fitted.states,
        chunk_size=fitted.chunk_size,
        reads_committed=metadata.chunking_mode is not None,
        has_memory=metadata.is_ours and MEMORY in metadata.supports,
    )
    return RemotePolicy(spec=spec, clients=clients, fit=fitted, settings=settings, action=context.env.action)


def _check_mode(chunking: ChunkingSpec, server: ServerMetadata, *, where: str) -> None:
    """Refuse a server whose chunks do not join as the evaluation asks, or that joins where none is asked."""
    wanted = chunking.mode if chunking.execution.commits else None
    if server.chunking_mode == wanted:
        return
    if wanted is None:
        raise SpecMismatchError(
            f"{where}: the server's chunks join what is committed ({server.chunking_mode}), and "
            f"the evaluation's mode is {chunking.mode}. Start it without --chunking-mode, or evaluate with "
            f"--set chunking.mode={server.chunking_mode}."
        )
    raise SpecMismatchError(
        f"{where}: chunking.mode={wanted} asks for chunks that join what is committed; the server's mode is "
        f"{server.chunking_mode or 'none of these'}. Start it with --chunking-mode {wanted}."
    )
