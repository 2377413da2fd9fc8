"""What a policy's memory is replaced by on the way: the world and what the policy sees of it are the same.

A change is made between two inferences, by `get_memory` and `set_memory`. Knows nothing of models: a memory
is arrays with names.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple  # Any: the task checks its arguments

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    MemoryArrays,
    ObservationWindow,
    Policy,
    RememberingPolicy,
    infer,
)
from vla_eval.errors import RecipeError, SpecMismatchError, some_of
from vla_eval.seeding import Stream, generator
from vla_eval.specs import PolicySpec
from vla_eval.strict.bounds import MAX_STEPS, Bounds, check_bounds

MemoryChangeKind = Literal[
    "transplant", "carry_over", "memory_noise", "hold_memory", "stale_memory", "erase_memory"
]


class Kind(NamedTuple):
    """One kind of change."""

    asks_for: str | None  # the field that it needs beside `at_step`
    has_donor: bool = False  # whether the memory of another episode is put in


KINDS: Mapping[MemoryChangeKind, Kind] = {
    "transplant": Kind("donor_env", has_donor=True),
    "carry_over": Kind(None, has_donor=True),
    "memory_noise": Kind("dose"),
    "hold_memory": Kind(None),
    "stale_memory": Kind("age_steps"),
    "erase_memory": Kind("part"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryChange:
    """One change of a policy's memory, in each episode.

    | kind | at the first inference at or after `at_step` |
    |---|---|
    | `transplant` | the memory is that of the same seed in a world with `donor_env`, at this moment |
    | `carry_over` | the memory is that which the episode of the seed before leaves behind |
    | `memory_noise` | each array gets normal noise, `dose` times its own standard deviation |
    | `hold_memory` | from then on, every inference begins with the memory of this moment |
    | `stale_memory` | from then on, actions are chosen with the memory of `age_steps` ago; it is updated |
    | `erase_memory` | `part` of the memory is what an episode begins with |
    """

    kind: MemoryChangeKind
    at_step: Annotated[int, Bounds(0, MAX_STEPS)] = 0
    donor_env: dict[str, Any] | None = None  # arguments of the donor's task that differ
    dose: Annotated[float, Bounds(0.0, 1000.0)] | None = None
    age_steps: Annotated[int, Bounds(1, MAX_STEPS)] | None = None
    part: str | None = None  # an array, or the part of several names before the first `/`

    def __post_init__(self) -> None:
        check_bounds(self, prefix="memory_change.")
        asked = KINDS[self.kind].asks_for
        for name in sorted({kind.asks_for for kind in KINDS.values() if kind.asks_for}):
            is_given = bool(getattr(self, name)) or getattr(self, name) == 0
            if is_given != (name == asked):
                expected = "a value" if name == asked else "none"
                raise RecipeError(
                    f"memory_change.{name}: expected {expected} for kind={self.kind}, found "
                    f"{getattr(self, name)!r}."
                )
        if self.kind == "carry_over" and self.at_step:
            raise RecipeError(
                f"memory_change.at_step: expected 0 for kind=carry_over, found {self.at_step}: what was left "
                "behind is there from the first inference on."
            )

    @property
    def has_donor(self) -> bool:
        """Whether the memory of another episode is put in."""
        return KINDS[self.kind].has_donor


def parts_of(begun: MemoryArrays, later: MemoryArrays) -> tuple[str, ...]:
    """Return what of a memory can be erased: arrays that an episode begins with, and groups of others."""
    single = [name for name, array in later.items() if name in begun and array.shape == begun[name].shape]
    return tuple(dict.fromkeys(name if name in single else _group(name) for name in later))


def memory_parts(policy: Policy, start: EpisodeStart) -> tuple[str, ...]:
    """Return `parts_of` a policy's memory after its last inference; the episode is begun again.

    None for a policy without memory.
    """
    if not isinstance(policy, RememberingPolicy) or not policy.spec.has_memory:
        return ()
    later = policy.get_memory(start.slot)
    policy.reset([start])
    return parts_of(policy.get_memory(start.slot), later)


def remembering(policy: Policy) -> RememberingPolicy:
    """Return the policy, if it has a memory that can be changed; else raise `SpecMismatchError`."""
    if isinstance(policy, RememberingPolicy) and policy.spec.has_memory:
        return policy
    raise SpecMismatchError(
        f"memory_change: policy '{policy.spec.name}' keeps nothing between two inferences that could be "
        "changed, or does not hand it out (`get_memory`, docs/lerobot_policies.md). Leave it out."
    )


class ChangedMemory:
    """A policy whose memory is changed on the way.

    Args:
        policy: the policy; the errors are those of `remembering`.
        change: what is changed.
        donors: slot -> the memory that is put in, of a change that has a donor.
    """

    def __init__(
        self, policy: Policy, change: MemoryChange, donors: Mapping[int, MemoryArrays] | None = None
    ) -> None:
        self._policy, self._inner = remembering(policy), policy
        self._change, self._donors = change, donors or {}
        self._episodes: dict[int, _Episode] = {}

    @property
    def spec(self) -> PolicySpec:
        """The policy's."""
        return self._inner.spec

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes."""
        self._inner.reset(episodes)
        for start in episodes:
            self._episodes[start.slot] = _Episode(start=start, begun=self._policy.get_memory(start.slot))

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Decide for one window."""
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Decide for each window, with the memory that the change makes of its episode's.

        Raises:
            SpecMismatchError: the policy refuses the memory, or has no such part.
        """
        if self._change.kind == "stale_memory":
            return self._act_stale(windows)
        for window in windows:
            if window.last.step >= self._change.at_step:
                self._replace(window.slot)
        return infer(self._inner, windows)

    def _replace(self, slot: int) -> None:
        episode, kind = self._episodes[slot], self._change.kind
        if kind == "hold_memory":
            if episode.held is None:
                episode.held = self._policy.get_memory(slot)
            self._policy.set_memory(slot, episode.held)
            return
        if episode.is_changed:
            return
        episode.is_changed = True
        new: MemoryArrays
        if kind == "memory_noise":
            new = noisy(self._policy.get_memory(slot), dose=self._change.dose or 0.0, seed=episode.start.seed)
        elif kind == "erase_memory":
            new = self._erased(self._policy.get_memory(slot), episode.begun)
        else:
            new = self._donors[slot]
        self._policy.set_memory(slot, new)

    def _erased(self, memory: MemoryArrays, begun: MemoryArrays) -> MemoryArrays:
        part = self._change.part or ""
        gone = {name for name in (*memory, *begun) if part in (name, _group(name))}
        if not gone:
            raise SpecMismatchError(
                f"memory_change.part: policy '{self.spec.name}': expected one of "
                f"{some_of(parts_of(begun, memory))}, found '{part}'."
            )
        return {name: array for name, array in memory.items() if name not in gone} | {
            name: array for name, array in begun.items() if name in gone
        }

    def _act_stale(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Let the memory take its course, and choose the actions with an earlier one."""
        for window in windows:
            kept = self._episodes[window.slot].earlier
            kept.append((window.last.step, self._policy.get_memory(window.slot)))
        chunks = infer(self._inner, windows)
        due = [window for window in windows if window.last.step >= self._change.at_step]
        if not due:
            return chunks
        own = {window.slot: self._policy.get_memory(window.slot) for window in due}
        for window in due:
            self._policy.set_memory(window.slot, self._aged(window))
        chosen = iter(infer(self._inner, due))
        for slot, memory in own.items():
            self._policy.set_memory(slot, memory)
        return [next(chosen) if window.slot in own else chunks[i] for i, window in enumerate(windows)]

    def _aged(self, window: ObservationWindow) -> MemoryArrays:
        """Return the newest memory that is old enough, or what the episode began with; forget older ones."""
        episode, latest = self._episodes[window.slot], window.last.step - (self._change.age_steps or 0)
        old = [index for index, (step, _) in enumerate(episode.earlier) if step <= latest]
        if not old:
            return episode.begun
        del episode.earlier[: old[-1]]
        return episode.earlier[0][1]


@dataclass(slots=True, kw_only=True)
class _Episode:
    """One episode whose memory is changed."""

    start: EpisodeStart
    begun: MemoryArrays  # what it began with
    is_changed: bool = False  # whether what happens once has happened
    held: MemoryArrays | None = None
    # control step of an inference -> the memory that it began with, oldest first
    earlier: list[tuple[int, MemoryArrays]] = field(default_factory=list)


def noisy(memory: MemoryArrays, *, dose: float, seed: int) -> dict[str, NDArray[Any]]:
    """Return a memory with normal noise of `dose` times the standard deviation of each array's numbers.

    Only finite numbers of floating-point arrays count and are changed; counters and masks stay as they are.
    """
    return {name: _with_noise(name, array, dose=dose, seed=seed) for name, array in memory.items()}


def _with_noise(name: str, array: NDArray[Any], *, dose: float, seed: int) -> NDArray[Any]:
    if not np.issubdtype(array.dtype, np.floating):
        return array
    numbers = array[np.isfinite(array)].astype(np.float64)
    if not numbers.size:
        return array
    # A stream for each name, so that an array's noise is the same whatever else there is.
    drawn = generator(seed, Stream.MEMORY, zlib.crc32(name.encode())).standard_normal(numbers.size)
    noised = array.copy()
    noised[np.isfinite(array)] = numbers + dose * numbers.std() * drawn
    return noised


def _group(name: str) -> str:
    return name.partition("/")[0]
