"""Training samples of a policy with memory: what it is given at that frame of a rollout."""

from collections.abc import Mapping
from typing import Any  # lerobot is untyped

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.data.frames.decoded_frames import DecodedFramesDataset, Sample
from vla_eval.models.shared.earlier_frames import (
    SEGMENT_PADDING_KEY,
    SampleMemory,
    Segments,
    in_places,
    place_fields,
)
from vla_eval.models.shared.frame_choice import FrameChoice, Seen

NO_ROW = -1


class RememberedFramesDataset(DecodedFramesDataset):
    """A dataset whose samples have memory; for the rest see `DecodedFramesDataset`.

    With `memory.segments` each field has an axis of time: the frames at which the policy writes, and its own;
    before the episode's beginning its first frame, marked in `SEGMENT_PADDING_KEY`.
    """

    def __init__(self, source: LeRobotDataset, memory: SampleMemory, **options: Any) -> None:
        super().__init__(source, **options)
        self._memory = memory
        self._shown = torch.empty((len(self), 0), dtype=torch.long)
        if memory.choice is not None:
            self._shown = self._chosen(memory.choice)

    @property
    def image_fields(self) -> tuple[str, ...]:
        """All fields that are images."""
        return (*self.meta.camera_keys, *place_fields(self._memory.cameras, self._shown.shape[1]))

    def __getitem__(self, index: int) -> Sample:
        """Return one sample; every tensor in it is a new one."""
        if self._memory.segments is None:
            return super().__getitem__(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        return self._in_segments(index % len(self), self._memory.segments)

    def _in_segments(self, index: int, segments: Segments) -> Sample:
        first = int(self._bounds[index, 0])
        rows = [first + number for number in segments.numbers(index - first)]
        n_missing = segments.n_segments - len(rows)
        frames = {row: super(RememberedFramesDataset, self).__getitem__(row) for row in rows}
        taken = [frames[row] for row in [first] * n_missing + rows]
        sample = {
            key: torch.stack([frame[key] for frame in taken]) if isinstance(value, torch.Tensor) else value
            for key, value in frames[index].items()
        }
        sample[SEGMENT_PADDING_KEY] = torch.arange(segments.n_segments) < n_missing
        return sample

    def _images(self, index: int, rows: Mapping[str, list[int]]) -> Sample:
        shown = self._shown[index].tolist()
        images: Sample = {}
        for camera in self._frames:
            if not shown or camera not in self._memory.cameras:
                images[camera] = self._image(camera, rows.get(camera, [index]))
                continue
            # In one call: an augmentation changes all frames of a sample alike.
            stack = self._image(camera, [index, *(index if row == NO_ROW else row for row in shown)])
            images[camera] = stack[0]
            there = [None if row == NO_ROW else image for row, image in zip(shown, stack[1:], strict=True)]
            images.update(in_places(camera, there, stack[0]))
        return images

    def _chosen(self, choice: FrameChoice) -> torch.Tensor:
        """Return (frames, places): which rows are shown with each, `NO_ROW` for none."""
        frames = self._frames[self._memory.cameras[0]]
        chosen = torch.full((len(self), choice.n_places), NO_ROW)
        seen = Seen()
        for row, first in enumerate(self._bounds[:, 0].tolist()):
            if row == first:
                seen = Seen()
            seen = choice.after(seen, np.asarray(frames[row]) if choice.looks else None)
            for place, number in enumerate(choice.shown(seen)):
                if number is not None:
                    chosen[row, place] = first + number
        return chosen
