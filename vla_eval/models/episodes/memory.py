"""The memory of several episodes in one pass: every row is shown its own frames, one control step at a time.

Rows have different numbers of new frames. Each step is a pass with all rows, and a row without a frame at
that step keeps its memory: what a row remembers is the same bits whatever the other rows are. Knows nothing
of slots, observations or actions.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol  # Any: lerobot is untyped

import torch
from torch import Tensor

from vla_eval.errors import SpecMismatchError
from vla_eval.models.episodes.running import Episode, Frame, frames_in_time

Memory = tuple[Tensor, ...]
"""What is remembered of B episodes, each tensor (B, …); a named tuple if the policy's is one."""


class Remembering(Protocol):
    """A LeRobot policy whose memory of several episodes is tensors with a row for each."""

    def begin_memory(self, n_episodes: int) -> Memory:
        """Return the memory before the first frame."""

    def remember(self, batch: dict[str, Any], memory: Memory) -> Memory:
        """Return the memory after the frames (B, T, …) of a batch."""


def remembers(policy: Any) -> bool:
    """Whether a policy has to be shown every frame."""
    return callable(getattr(policy, "remember", None))


def remembers_singly(policy: Any) -> bool:
    """Whether a policy takes one frame per episode, (B, …), as at an inference, without an axis of time."""
    return remembers_in_rows(policy) and bool(getattr(policy, "remembers_singly", False))


def remembers_in_rows(policy: Any) -> bool:
    """Whether a policy can be shown the frames of several episodes in one pass."""
    return remembers(policy) and callable(getattr(policy, "begin_memory", None))


def recall(
    policy: Remembering, rows: Sequence[Episode], preprocess: Callable[[Sequence[Frame]], dict[str, Any]]
) -> Memory:
    """Return the memory (B, …) after all unseen frames; `preprocess` batches one frame per row."""
    singly = remembers_singly(policy)
    first = policy.begin_memory(len(rows))
    _check(first, first, len(rows), where="begin_memory")
    begun = [memory_of(first, row) if e.memory is None else e.memory for row, e in enumerate(rows)]
    memory = like(first, [torch.stack(parts) for parts in zip(*begun, strict=True)])
    for index in range(max(len(episode.unseen) for episode in rows)):
        # A row without a frame at this step computes with its newest one, to no effect.
        frames = [episode.unseen[min(index, len(episode.unseen) - 1)] for episode in rows]
        has_frame = torch.tensor([index < len(episode.unseen) for episode in rows])
        batch = preprocess([frame if singly else frames_in_time([frame]) for frame in frames])
        after = policy.remember(batch, like(memory, [part.clone() for part in memory]))
        _check(after, memory, len(rows), where="remember")
        memory = like(memory, [_chosen(has_frame, *parts) for parts in zip(after, memory, strict=True)])
    return memory


def memory_of(memory: Memory, row: int) -> Memory:
    """Return a copy of what is remembered of one episode: it must not keep the memory of all others."""
    return like(memory, [part[row].clone() for part in memory])


def _chosen(has_frame: Tensor, after: Tensor, before: Tensor) -> Tensor:
    """Return rows of `after` with a frame, else of `before`; contiguous, or other kernels would compute."""
    per_row = has_frame.to(after.device).reshape(-1, *[1] * (after.ndim - 1))
    return torch.where(per_row, after, before).contiguous()


def like(memory: Memory, parts: Sequence[Tensor]) -> Memory:
    """Return these parts as a memory of the same kind."""
    make = getattr(type(memory), "_make", tuple)  # of named tuples
    return make(parts)


def _check(memory: Any, expected: Memory, n_rows: int, *, where: str) -> None:
    described = _described(memory)
    is_tensors = isinstance(memory, tuple) and all(isinstance(part, Tensor) for part in memory)
    if not is_tensors or any(part.ndim == 0 or len(part) != n_rows for part in memory):
        raise SpecMismatchError(
            f"`{where}` of the policy: expected a tuple of tensors ({n_rows}, …), found {described}. Give "
            "each tensor a row for each episode, or leave out `begin_memory`: episodes are then asked one "
            "by one."
        )
    if described != _described(expected):
        raise SpecMismatchError(
            f"`{where}` of the policy: expected a memory like that of `begin_memory`, "
            f"{_described(expected)}; found {described}."
        )


def _described(memory: Any) -> str:
    if not isinstance(memory, tuple):
        return type(memory).__name__
    return str(
        [
            f"{part.dtype} {tuple(part.shape)}" if isinstance(part, Tensor) else type(part).__name__
            for part in memory
        ]
    )
