"""Read some frames of a captured episode back from its video. Knows nothing of results."""

import math
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np

from vla_eval.core import ImageArray
from vla_eval.errors import ViewingError
from vla_eval.viz.frames import PANEL_PX
from vla_eval.viz.mp4 import open_mp4
from vla_eval.viz.video import CUE_SECONDS, HOLD_SECONDS


class StripFrame(NamedTuple):
    """The images of one step, (H, W, 3) uint8, without the text above them."""

    step: int
    image: ImageArray


def read_strip(path: Path, *, n_frames: int, n_steps: int, control_hz: float) -> list[StripFrame]:
    """Return at most `n_frames` frames of a video from first to last step, as even as it has them."""
    try:
        with open_mp4(path, ViewingError) as container:
            rate = container.streams.video[0].average_rate
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except (OSError, av.error.FFmpegError) as exc:
        raise ViewingError(
            f"{path}: the video cannot be read ({exc}). Remove it, or capture it again."
        ) from exc
    if rate is None or not frames:
        raise ViewingError(f"{path}: the video has no frames. Remove it, or capture it again.")
    stride = round(control_hz / float(rate))
    n_captured = -(-n_steps // stride) + 1
    # The first frames, those of the cue, are repeated, and so is the last one: see `write_video`.
    n_repeats = len(frames) - round(HOLD_SECONDS * float(rate)) - n_captured
    if n_repeats < 0:
        raise ViewingError(
            f"{path}: the video is too short for {n_steps} steps. Remove it, or capture again."
        )
    n_cue = _most_cue_frames(n_repeats, n_captured, float(rate))
    # Between the first frame of the cue and its end, no frame of the video is known by its step.
    after = np.linspace(min(max(n_cue, 1), n_captured - 1), n_captured - 1, n_frames - 1)
    chosen = [int(i) for i in np.unique([0, *after.round().astype(int)])]
    return [
        StripFrame(
            min(i * stride, n_steps),
            np.ascontiguousarray(frames[i + n_repeats if i else 0][PANEL_PX:], dtype=np.uint8),
        )
        for i in chosen
    ]


def _most_cue_frames(n_repeats: int, n_captured: int, rate_hz: float) -> int:
    """Return the most captured frames of the cue that would be repeated so often in all; 0 for no repeats."""
    if n_repeats == 0:
        return 0
    fitting = (
        n
        for n in range(n_captured, 0, -1)
        if n * (max(1, math.ceil(CUE_SECONDS * rate_hz / n)) - 1) == n_repeats
    )
    return next(fitting, n_captured - 1)
