"""The fields by which a policy is given earlier frames: an image and a mask for each place and camera."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any  # arrays of several dtypes

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_eval.models.shared.frame_choice import BLOCKS, Event, FrameChoice, Seen
from vla_eval.models.shared.images import in_bytes

SEGMENT_PADDING_KEY = "segment_is_pad"
"""(B, T) of a training batch in segments: which come before the episode's beginning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Segments:
    """The frames of an episode at which its memory tokens are written, for training."""

    stride: int  # control steps between them, from the first frame on
    # of a sample, the frame itself among them; shorter ones are padded at their beginning
    n_segments: int

    def numbers(self, newest: int) -> list[int]:
        """Return the numbers of the frames of the sample that ends with this one."""
        return [*range(0, newest, self.stride), newest]


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleMemory:
    """What a training sample has in addition to its own frame."""

    choice: FrameChoice | None  # of earlier frames; None: none are shown
    cameras: tuple[str, ...]  # fields of the dataset of which they are shown; a rule looks at the first
    segments: Segments | None  # None: a sample is one frame


def place_field(camera: str, place: int) -> str:
    """Return the field of the image in a place, counted from 1."""
    return f"{camera}_m{place}"


def mask_field(image_field: str) -> str:
    """Return the field of the mask of an image; lerobot's SmolVLA reads it by this name."""
    return f"{image_field}_padding_mask"


def place_fields(cameras: Iterable[str], n_places: int) -> tuple[str, ...]:
    """Return the fields of all images, place by place."""
    cameras = tuple(cameras)
    return tuple(place_field(camera, place) for place in range(1, n_places + 1) for camera in cameras)


def in_places(camera: str, images: Sequence[Tensor | None], like: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Yield fields of a camera's images (3, H, W), shaped as `like`, and of their masks, place by place."""
    for place, image in enumerate(images, start=1):
        name = place_field(camera, place)
        yield name, torch.zeros_like(like) if image is None else image
        yield mask_field(name), torch.tensor(image is not None)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMemory:
    """The earlier frames of one running episode; of constant size."""

    choice: FrameChoice  # see there
    cameras: tuple[str, ...]  # fields of which images are kept; the rule looks at the first
    seen: Seen = field(default_factory=Seen)  # what the rule keeps
    # number of a frame -> its images by field, float32 in [0, 1]; those that may be shown
    images: Mapping[int, Mapping[str, Tensor]] = field(default_factory=dict)

    def after(self, frame: Mapping[str, Tensor]) -> "FrameMemory":
        """Return the memory after one more frame."""
        look = in_bytes(frame[self.cameras[0]]).numpy() if self.choice.looks else None
        seen = self.choice.after(self.seen, look)
        images = {**self.images, seen.n_frames - 1: {camera: frame[camera] for camera in self.cameras}}
        wanted = self.choice.wanted(seen)
        kept = {number: images[number] for number in images if number in wanted}
        return replace(self, seen=seen, images=kept)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all of it: number of frames, what the rule keeps, and the images with their numbers."""
        found: dict[str, NDArray[Any]] = {"n_frames": np.array(self.seen.n_frames)}
        if self.seen.blocks is not None:
            found |= {f"blocks_{n}": blocks for n, blocks in zip(BLOCKS, self.seen.blocks, strict=True)}
        if self.seen.events:
            found["events"] = np.array(self.seen.events)
        if self.images:
            found["numbers"] = np.array(sorted(self.images))
            for camera in self.cameras:
                images = [self.images[number][camera] for number in sorted(self.images)]
                found[f"images/{camera}"] = torch.stack(images).numpy()
        return found

    def with_arrays(self, arrays: Mapping[str, NDArray[Any]]) -> "FrameMemory":
        """Return a memory of the same rule with what `arrays` returned; `ValueError` for others."""
        known = {"n_frames", "events", "numbers", *(f"blocks_{n}" for n in BLOCKS)}
        known |= {f"images/{camera}" for camera in self.cameras}
        blocks = tuple(arrays[f"blocks_{n}"] for n in BLOCKS if f"blocks_{n}" in arrays)
        events = arrays.get("events", np.empty((0, 2)))
        numbers = arrays.get("numbers", np.empty(0, dtype=np.int64))
        images = {camera: arrays[f"images/{camera}"] for camera in self.cameras if len(numbers)}
        problems = (
            (bool(set(arrays) - known), f"expected {', '.join(sorted(known))}, found {', '.join(arrays)}"),
            (
                arrays["n_frames"].shape != ()
                or arrays["n_frames"].dtype.kind != "i"
                or arrays["n_frames"] < 0,
                "n_frames is no number of frames",
            ),
            (
                [block.shape for block in blocks] not in ([], [(3, n, n) for n in BLOCKS]),
                "the blocks have other shapes",
            ),
            (
                events.ndim != 2 or events.shape[1:] != (2,) or not np.isfinite(events).all(),
                f"expected finite events (N, 2), found {events.shape}",
            ),
            (numbers.ndim != 1 or numbers.dtype.kind != "i", "the numbers of images are no list of numbers"),
            (
                any(
                    array.shape[:1] != numbers.shape or array.dtype != np.float32 for array in images.values()
                ),
                "expected a float32 image for each number",
            ),
        )
        for is_wrong, problem in problems:
            if is_wrong:
                raise ValueError(problem)
        seen = Seen(
            n_frames=int(arrays["n_frames"]),
            blocks=blocks or None,
            events=tuple(Event(int(number), float(changed)) for number, changed in events),
        )
        if seen.n_frames and not self.choice.wanted(seen) <= set(numbers.tolist()):
            raise ValueError(f"expected images of the frames {sorted(self.choice.wanted(seen))}")
        kept = {
            int(number): {camera: torch.from_numpy(array[i].copy()) for camera, array in images.items()}
            for i, number in enumerate(numbers)
        }
        return replace(self, seen=seen, images=kept)

    def fields(self) -> dict[str, Tensor]:
        """Return the further fields of the newest frame."""
        newest = self.images[self.seen.n_frames - 1]
        shown = self.choice.shown(self.seen)
        found: dict[str, Tensor] = {}
        for camera in self.cameras:
            images = [None if number is None else self.images[number][camera] for number in shown]
            found.update(in_places(camera, images, newest[camera]))
        return found
