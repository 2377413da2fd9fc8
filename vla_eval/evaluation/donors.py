"""The episodes whose memory is put into others: run first, by the same policy in the same slots."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace

from vla_eval.config.environment import EnvSettings
from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    MemoryArrays,
    ObservationWindow,
    Policy,
    SimEnv,
    Stage,
    infer,
)
from vla_eval.errors import SpecMismatchError
from vla_eval.memory_change import MemoryChange, remembering
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec


class _AllTaken(Exception):  # no error: the donors' episodes end here
    """The memory of each donor has been taken."""


def donor_settings(settings: EnvSettings, change: MemoryChange) -> EnvSettings:
    """Return the donors' environment."""
    return replace(settings, kwargs={**settings.kwargs, **(change.donor_env or {})})


def donor_memories(
    env: SimEnv,
    policy: Policy,
    starts: Sequence[EpisodeStart],
    settings: RolloutSettings,
    change: MemoryChange,
    *,
    heartbeat: Callable[[Stage], None],
) -> dict[int, MemoryArrays]:
    """Return slot -> the memory that is put into the episode of this slot.

    Raises:
        SpecMismatchError: as `rollout`; the policy has no memory; or a donor's episode ended before.
    """
    if change.kind == "carry_over":
        before = [replace(start, seed=start.seed - 1) for start in starts]
        rollout(env, policy, before, settings, heartbeat=heartbeat)
        return {start.slot: remembering(policy).get_memory(start.slot) for start in before}
    taking = _Taking(policy, change.at_step, n_slots=len(starts))
    with contextlib.suppress(_AllTaken):
        rollout(env, taking, starts, replace(settings, stop_at_success=False), heartbeat=heartbeat)
        raise SpecMismatchError(
            f"memory_change.at_step={change.at_step}: policy '{policy.spec.name}': the episode whose memory "
            "is to be taken has no inference at this step or after it. Use an earlier step."
        )
    return taking.taken


class _Taking:
    """A policy whose memory is taken before its first inference at or after a step."""

    def __init__(self, policy: Policy, at_step: int, *, n_slots: int) -> None:
        self._policy, self._at_step, self._n_slots = policy, at_step, n_slots
        self.taken: dict[int, MemoryArrays] = {}

    @property
    def spec(self) -> PolicySpec:
        return self._policy.spec

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        self._policy.reset(episodes)

    def act(self, window: ObservationWindow) -> ActionChunk:
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        for window in windows:
            if window.last.step >= self._at_step and window.slot not in self.taken:
                self.taken[window.slot] = remembering(self._policy).get_memory(window.slot)
        if len(self.taken) == self._n_slots:
            raise _AllTaken
        return infer(self._policy, windows)
