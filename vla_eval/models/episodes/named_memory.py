"""What a policy keeps of one episode as arrays with names, and back: complete, so that it can be moved.

| name | what |
|---|---|
| `policy/…` | what the policy's `remember` returns, a name for each tensor |
| `queues/…` | the queues of a policy that is asked for one action per step |
| `frames/FIELD` | (T, …) the frames that the next inference reads again, oldest first |
| `earlier/…` | the frames that are shown as further images, see `FrameMemory` |

bfloat16, which numpy does not have, is given as float32, which holds it exactly.
"""

import copy
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any  # queues hold whatever a policy of lerobot keeps

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_eval.core import MemoryArrays
from vla_eval.errors import SpecMismatchError, did_you_mean
from vla_eval.models.episodes.memory import Memory, like
from vla_eval.models.episodes.running import Episode

POLICY, QUEUES, FRAMES, EARLIER = "policy", "queues", "frames", "earlier"


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryLayout:
    """What one policy keeps of an episode between two inferences."""

    policy: str  # its name, for messages
    # what it begins with, a tensor (…) for each part of one episode; None: it has no `remember`
    begun: Memory | None = None
    has_axis: bool = False  # whether its memory has an axis of length 1 for the episode
    queues: Mapping[str, Any] | None = None  # its queues when an episode begins; None: it has none
    n_frames: int = 0  # so many frames are read again at most
    fields: tuple[str, ...] = ()  # of a frame
    has_earlier: bool = False  # whether it is shown earlier frames

    @property
    def is_empty(self) -> bool:
        """Whether nothing is kept."""
        return self.begun is None and self.queues is None and not self.n_frames and not self.has_earlier

    def arrays(self, episode: Episode) -> dict[str, NDArray[Any]]:
        """Return what is kept of an episode after its last inference; at first, what it begins with."""
        found: dict[str, Tensor] = {}
        if self.begun is not None:
            memory = self.begun if episode.memory is None else episode.memory
            strip = self.has_axis and episode.memory is not None
            found |= {
                f"{POLICY}/{name}": part[0] if strip else part
                for name, part in zip(part_names(self.begun), memory, strict=True)
            }
        if self.queues is not None:
            queues = self.queues if episode.memory is None else episode.memory
            found |= {f"{QUEUES}/{name}": part for name, part in _of_queues(queues)}
        kept = episode.frames[-self.n_frames :] if self.n_frames else ()
        for field in kept[0] if kept else ():
            found[f"{FRAMES}/{field}"] = torch.stack([frame[field] for frame in kept])
        arrays = {name: _as_array(part) for name, part in found.items()}
        if episode.earlier is not None:
            arrays |= {f"{EARLIER}/{name}": array for name, array in episode.earlier.arrays().items()}
        return arrays

    def replaced(self, episode: Episode, arrays: MemoryArrays) -> Episode:
        """Return the episode with this in place of what is kept of it.

        Raises:
            SpecMismatchError: the arrays are not what `arrays` returns for this policy.
        """
        left = dict(arrays)
        changes: dict[str, Any] = {"frames": self._frames(left, episode)}
        if self.begun is not None:
            parts = [
                self._part(left, f"{POLICY}/{name}", part)
                for name, part in zip(part_names(self.begun), self.begun, strict=True)
            ]
            changes["memory"] = like(self.begun, [part[None] for part in parts] if self.has_axis else parts)
        if self.queues is not None:
            changes["memory"] = self._queues(left)
        if episode.earlier is not None:
            own = {name.removeprefix(f"{EARLIER}/"): array for name, array in _taken(left, EARLIER).items()}
            try:
                changes["earlier"] = episode.earlier.with_arrays(own)
            except (KeyError, ValueError) as exc:
                raise self._refused(f"'{EARLIER}/…': {exc}") from exc
        if left:
            name, known = next(iter(left)), self.arrays(episode)
            raise self._refused(
                f"expected {', '.join(known) or 'no arrays'}, found '{name}'.{did_you_mean(name, known)}"
            )
        return replace(episode, **changes)

    def _part(self, left: dict[str, NDArray[Any]], name: str, begun: Tensor) -> Tensor:
        expected = _as_array(begun)
        wanted = f"'{name}': expected {expected.dtype} {expected.shape}"
        if name not in left:
            raise self._refused(f"{wanted}, found {', '.join(left) or 'no arrays'}")
        found = left.pop(name)
        if found.dtype != expected.dtype or found.shape != expected.shape:
            raise self._refused(f"{wanted}, found {found.dtype} {found.shape}")
        return torch.from_numpy(found.copy()).to(begun.device, begun.dtype)

    def _frames(self, left: dict[str, NDArray[Any]], episode: Episode) -> tuple[Mapping[str, Tensor], ...]:
        arrays = _taken(left, FRAMES)
        if not arrays:
            return ()
        names = {f"{FRAMES}/{field}" for field in self.fields}
        if not self.n_frames or set(arrays) != names:
            raise self._refused(
                f"expected frames of {', '.join(sorted(names)) if self.n_frames else 'no field'}, found "
                f"{', '.join(sorted(arrays))}"
            )
        for name, array in arrays.items():
            shown = (
                tuple(episode.frames[-1][name.removeprefix(f"{FRAMES}/")].shape) if episode.frames else None
            )
            is_sound = array.ndim > 0 and 0 < len(array) <= self.n_frames and array.dtype == np.float32
            if not is_sound or (shown is not None and array.shape[1:] != shown):
                raise self._refused(
                    f"'{name}': expected float32 (T, {'…' if shown is None else str(shown)[1:-1]}) with T "
                    f"from 1 to {self.n_frames}, found {array.dtype} {array.shape}"
                )
        lengths = {len(array) for array in arrays.values()}
        if len(lengths) > 1:
            raise self._refused(f"expected as many frames of each field, found {sorted(lengths)}")
        tensors = {name.removeprefix(f"{FRAMES}/"): torch.from_numpy(a.copy()) for name, a in arrays.items()}
        return tuple({field: part[i] for field, part in tensors.items()} for i in range(lengths.pop()))

    def _queues(self, left: dict[str, NDArray[Any]]) -> Mapping[str, Any]:
        made = copy.deepcopy(dict(self.queues or {}))
        for name, array in _taken(left, QUEUES).items():
            owner, _, key = name.removeprefix(f"{QUEUES}/").partition("/")
            own = made.get(owner)
            if owner not in made or (isinstance(own, Mapping) and key not in own):
                raise self._refused(f"'{name}': there is no such queue")
            tensor = torch.from_numpy(array.copy())
            if not isinstance(own, dict):
                made[owner] = tensor
            elif array.ndim and len(array) <= (own[key].maxlen or len(array)):
                own[key].extend(tensor.unbind())
            else:
                raise self._refused(f"'{name}': expected at most {own[key].maxlen}, found {array.shape}")
        return made

    def _refused(self, problem: str) -> SpecMismatchError:
        return SpecMismatchError(
            f"policy '{self.policy}', set_memory: {problem}. Give it what `get_memory` of the same policy "
            "returned."
        )


def part_names(memory: Memory) -> tuple[str, ...]:
    """Return the names of a memory's tensors: its fields', or their numbers."""
    return tuple(getattr(memory, "_fields", map(str, range(len(memory)))))


def _taken(left: dict[str, NDArray[Any]], group: str) -> dict[str, NDArray[Any]]:
    return {name: left.pop(name) for name in list(left) if name.startswith(f"{group}/")}


def _as_array(part: Tensor) -> NDArray[Any]:
    whole = part.detach().to("cpu", copy=True)
    array: NDArray[Any] = (whole.to(torch.float32) if part.dtype == torch.bfloat16 else whole).numpy()
    return array


def _of_queues(queues: Mapping[str, Any]) -> Sequence[tuple[str, Tensor]]:
    """Return what is in the queues: those that hold nothing have no name."""
    found: list[tuple[str, Tensor]] = []
    for name, value in queues.items():
        for key, kept in value.items() if isinstance(value, Mapping) else [("", value)]:
            own = f"{name}/{key}" if key else name
            if isinstance(kept, deque) and kept:
                found.append((own, torch.stack(tuple(kept))))
            elif isinstance(kept, Tensor):
                found.append((own, kept))
    return found
