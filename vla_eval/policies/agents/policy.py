"""The adapter `agent`: what `mikasa-vla train-agent` trained; an inference per step, a memory per episode."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any  # the library's networks and what they remember

import numpy as np

from vla_eval.checkpoints.bases import no_weights
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.trained_with import refuse_differences
from vla_eval.core import ActionChunk, EpisodeStart, MemoryArrays, ObservationWindow
from vla_eval.errors import SpecMismatchError
from vla_eval.policies.agents.imitator import CoreNetwork
from vla_eval.policies.agents.network import AgentNetwork, load_network, read_about
from vla_eval.policies.agents.observing import Seen, action_space, as_action, reader_of
from vla_eval.policies.context import PolicyContext
from vla_eval.specs import PolicySpec

LSTM_STATE = ("policy/hidden", "policy/cell")
"""Names of what the library's LSTM keeps, each (layers, 1, units) float32."""


class AgentPolicy:
    """The most likely action at each step; nothing is drawn."""

    def __init__(self, context: PolicyContext, network: Any, about: AgentNetwork) -> None:
        reader = reader_of(context.env, about.observation, n_candidates=context.n_candidates)
        self._read, self._network, self._about = reader.read, network, about
        self._action, self._task = context.env.action, context.env.task
        self._memory: dict[int, Any] = {}
        self._begun = _begun(network)
        self.spec = PolicySpec(
            name=context.name,
            reads="every",
            cameras=reader.cameras,
            states=reader.states,
            chunk_size=about.chunk_size,
            privileged=reader.privileged,
            has_memory=bool(self._begun),
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes: with an empty memory."""
        for episode in episodes:
            self._memory[episode.slot] = None

    def forget(self, slots: Sequence[int]) -> None:
        """Release the memory of these slots."""
        for slot in slots:
            self._memory.pop(slot, None)

    def get_memory(self, slot: int) -> dict[str, np.ndarray[Any, Any]]:
        """Return what the network keeps: the state of an LSTM, the parts of a core; nothing of others."""
        if not self._begun:
            return {}
        kept = self._memory[slot] or self._begun.values()
        return {name: np.array(part) for name, part in zip(self._begun, kept, strict=True)}

    def set_memory(self, slot: int, memory: MemoryArrays) -> None:
        """Put a memory in place of that of a slot's episode."""
        expected, found = _kinds(self._begun), _kinds(memory)
        if found != expected:
            raise SpecMismatchError(
                f"policy '{self.spec.name}', set_memory: expected {expected}, found {found}. Give it "
                "what `get_memory` of the same policy returned."
            )
        self._memory[slot] = tuple(np.array(memory[name]) for name in expected) or None

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the action for the last observation."""
        return self.act_on(self._read(window.last), slot=window.slot)

    def act_on(self, seen: Seen, *, slot: int) -> ActionChunk:
        """Return the action for what the network is given, by name; see `given_space`."""
        memory, is_first = self._memory[slot], self._memory[slot] is None
        self._check_shapes({name: values.shape for name, values in seen.items()})
        chosen, remembered = self._network.predict(
            {name: values[None] for name, values in seen.items()},
            state=memory,
            episode_start=np.array([is_first]),
            deterministic=True,
        )
        self._memory[slot] = remembered
        return ActionChunk(actions=as_action(self._action, chosen[0])[None])

    def _check_shapes(self, found: dict[str, tuple[int, ...]]) -> None:
        expected = self._about.shapes
        if found != expected:
            line = f"inputs: expected {expected} (trained on {self._about.task}), found {found}."
            refuse_differences([line], policy=self.spec.name, task=self._task)


def _begun(network: Any) -> Mapping[str, np.ndarray[Any, Any]]:
    """Return the memory that an episode begins with, by name; none of a network without."""
    if isinstance(network, CoreNetwork):
        return network.begun()
    shape = getattr(network, "lstm_hidden_state_shape", None)
    return {} if shape is None else {name: np.zeros(shape, np.float32) for name in LSTM_STATE}


def _kinds(memory: MemoryArrays) -> dict[str, str]:
    return {name: f"{part.dtype} {part.shape}" for name, part in memory.items()}


def make_agent(context: PolicyContext, *, checkpoint: str | None = None) -> AgentPolicy:
    """Make the policy of a checkpoint that `mikasa-vla train-agent` wrote.

    Args:
        context: what it is made for.
        checkpoint: a run's folder, or a checkpoint's.

    Raises:
        CheckpointError: there is none, or it is damaged.
        SpecMismatchError: the task's actions are not those that it was trained with.
        MissingDependencyError: stable-baselines3 is not installed.
    """
    if checkpoint is None:
        raise no_weights(context.name)
    folder = find_checkpoint(Path(checkpoint))
    about = read_about(folder)
    pairs = (
        ("control mode", about.control_mode, context.env.action.control_mode),
        ("action dimensions", about.action_dims, context.env.action.dims),
    )
    trained_in = " ".join(f"--set env.{name}={value}" for name, value in about.env.items())
    lines = [
        f"{what}: expected {trained}, found {asked}. Evaluate it on {about.task} {trained_in}".rstrip() + "."
        for what, trained, asked in pairs
        if trained != asked
    ]
    refuse_differences(lines, policy=context.name, task=context.env.task)
    return AgentPolicy(context, load_network(folder, about, action_space(context.env.action)), about)
