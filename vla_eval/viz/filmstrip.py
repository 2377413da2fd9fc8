"""Read some frames of a captured episode back from its video. Knows nothing of results."""

from pathlib import Path
from typing import NamedTuple

import av
import numpy as np

from vla_eval.core import ImageArray
from vla_eval.errors import ViewingError
from vla_eval.viz.frames import PANEL_PX
from vla_eval.viz.video import HOLD_SECONDS


class StripFrame(NamedTuple):
    """The images of one step, (H, W, 3) uint8, without the text above them."""

    step: int
    image: ImageArray


def read_strip(path: Path, *, n_frames: int, n_steps: int, control_hz: float) -> list[StripFrame]:
    """Return frames from the first to the last step, as evenly spaced as the video has them.

    Args:
        path: a video that `write_video` has written.
        n_frames: how many; fewer if the video has not so many.
        n_steps: control steps of the episode, which the last frame is of.
        control_hz: control steps per second.

    Raises:
        ViewingError: the video cannot be read.
    """
    try:
        with av.open(str(path)) as container:
            rate = container.streams.video[0].average_rate
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except (OSError, av.error.FFmpegError) as exc:
        raise ViewingError(
            f"{path}: the video cannot be read ({exc}). Remove it, or capture it again."
        ) from exc
    if rate is None or not frames:
        raise ViewingError(f"{path}: the video has no frames. Remove it, or capture it again.")
    n_captured = max(1, len(frames) - round(HOLD_SECONDS * float(rate)))
    stride = round(control_hz / float(rate))
    chosen = np.unique(np.linspace(0, n_captured - 1, min(n_frames, n_captured)).round().astype(int))
    return [
        StripFrame(min(int(i) * stride, n_steps), np.ascontiguousarray(frames[i][PANEL_PX:], dtype=np.uint8))
        for i in chosen
    ]
