"""What a LeRobot policy is given of running episodes: frames in time, seeds, noise, a row of a pass."""

import copy
import zlib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.core import CommittedActions, EpisodeStart
from vla_eval.errors import InvalidActionError
from vla_eval.models.families import family_of
from vla_eval.models.shared.earlier_frames import FrameMemory
from vla_eval.seeding import Stream, generator

Frame = Mapping[str, Tensor]

N_SEED_BITS = 63


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """A running episode as it is at one inference."""

    start: EpisodeStart  # what it began with
    frames: tuple[Frame, ...] = ()  # the newest frames that an inference may read, oldest first
    unseen: tuple[Frame, ...] = ()  # the frames since the previous inference, oldest first
    # what the policy remembers of the frames before; None at the beginning
    memory: Any = None  # whatever the policy's `remember` returns
    # the earlier frames that the policy is shown as further images; None: it is shown none
    earlier: FrameMemory | None = None
    step: int = 0  # of the newest frame
    committed: CommittedActions | None = None  # what the next chunk has to join

    def shown(self, unseen: Sequence[Frame], *, step: int, n_kept: int) -> "Episode":
        """Return the episode after these frames, of which an inference may read the newest `n_kept`."""
        earlier = self.earlier
        if earlier is not None:
            shown = []
            for frame in unseen:
                earlier = earlier.after(frame)
                shown.append({**frame, **earlier.fields()})
            unseen = shown
        frames = deque(self.frames, maxlen=n_kept)
        frames.extend(unseen)
        return replace(self, frames=tuple(frames), unseen=tuple(unseen), earlier=earlier, step=step)

    def read(self, deltas: Sequence[int], *, masks_history: bool) -> Frame:
        """Return the frame (…) of an inference, or frames in time (T, …), 0 being the newest."""
        if not deltas:
            return self.frames[-1]
        last = len(self.frames) - 1
        frames = frames_in_time([self.frames[max(0, last + delta)] for delta in deltas])
        if not masks_history:
            return frames
        is_pad = torch.tensor([last + delta < 0 for delta in deltas])
        return {**frames, **{f"{key}_is_pad": is_pad for key in frames}}

    def seed(self) -> int:
        """Return the seed of the next inference; the same wherever and with whatever it runs."""
        start = self.start
        rng = generator(start.seed, Stream.POLICY, zlib.crc32(start.task.encode()), start.run, self.step)
        return int(rng.integers(1 << N_SEED_BITS))


def in_rows(episodes: Sequence[Episode], n_rows: int) -> list[Episode]:
    """Return which episode each row computes, some repeated; raise if two want a row, or it is not there."""
    due: dict[int, Episode] = {}
    for episode in episodes:
        row, slot = episode.start.row, episode.start.slot
        if not 0 <= row < n_rows:
            raise InvalidActionError(
                f"slot {slot}: expected a row from 0 to {n_rows - 1}, found {row}: a pass of this policy has "
                f"{n_rows} rows. Reset the episode with another row, or make the policy with more slots."
            )
        if row in due:
            raise InvalidActionError(
                f"slots {due[row].start.slot} and {slot}: both are in row {row} of one pass. Infer for them "
                "in separate calls, or reset one of them with another row."
            )
        due[row] = episode
    return [due.get(row, episodes[0]) for row in range(n_rows)]


def given_noise(seeds: Iterable[int], shape: tuple[int, int]) -> Tensor:
    """Return the noise (B, *shape) of these inferences."""
    # On the CPU: the same draws on every device.
    return torch.stack([torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds])


def frames_in_time(frames: Sequence[Frame]) -> dict[str, Tensor]:
    """Return frames (…) as one of (T, …)."""
    return {key: torch.stack([frame[key] for frame in frames]) for key in frames[0]}


def begun_queues(policy: Any) -> Mapping[str, Any] | None:
    """Return the queues of an episode that begins, of a policy that is asked for one action per step."""
    owner = policy.select_action.__self__
    names = family_of(owner.config.type).queues
    if not names:
        return None
    owner.reset()
    return {name: copy.deepcopy(getattr(owner, name)) for name in names}


class Step(NamedTuple):
    """A chunk (B, 1, D) of one action, and the policy's queues after it."""

    action: Tensor
    queues: Mapping[str, Any]


def select_step(policy: Any, batch: dict[str, Any], queues: Mapping[str, Any] | None) -> Step:
    """Return the next action for the newest frame (B, …); `queues` stay as they are; None: it begins.

    Each episode has its own instance of the queues that a policy of such a type keeps.
    """
    owner = policy.select_action.__self__  # of a policy with a LoRA adapter, not what is around it
    for name, value in (queues or {}).items():
        setattr(owner, name, copy.deepcopy(value))
    action: Tensor = owner.select_action(batch)
    kept = {name: getattr(owner, name) for name in family_of(owner.config.type).queues}
    return Step(action.unsqueeze(1), kept)


def batch_of(frames: Sequence[Frame], episodes: Iterable[Episode]) -> dict[str, Any]:
    """Return frames (…), one per episode, as lerobot's preprocessors take them: (B, …), and instructions."""
    batch: dict[str, Any] = dict(frames_in_time(frames))
    return {**batch, "task": [episode.start.instruction for episode in episodes]}
