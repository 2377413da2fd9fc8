"""Write a taped episode as an H.264 mp4 that opens in a browser, and its first and last frame as a JPEG."""

from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np
from PIL import Image

from vla_eval.errors import ViewingError
from vla_eval.records import EpisodeRecord
from vla_eval.viz.frames import compose
from vla_eval.viz.tape import EpisodeTape

HOLD_SECONDS = 1.0  # the last frame stays, so that the outcome can be read
CODEC: Literal["libx264"] = "libx264"
OPTIONS: dict[str, object] = {"crf": "23", "preset": "veryfast", "threads": "1"}
JPEG_QUALITY = 85


def write_video(
    tape: EpisodeTape, record: EpisodeRecord, path: Path, *, thumbnail: Path, frame_rate_hz: float
) -> None:
    """Write the captured steps of an episode.

    Args:
        tape: the episode.
        record: its record.
        path: the mp4; it is there whole or not at all.
        thumbnail: the JPEG: the first frame, which shows the cue, and beside it the last one, which shows
            what was chosen.
        frame_rate_hz: captured steps per second of the episode, so that the video is as fast as the episode.

    Raises:
        ViewingError: no step has images, or the file cannot be written.
    """
    captured = tape.captured()
    if not captured:
        raise ViewingError(
            f"{path}: no step of this episode has an image. The environment was made without cameras."
        )
    unfinished = path.with_suffix(".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        frames = [compose(tape, step, record) for step in captured]
        with av.open(str(unfinished), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = container.add_stream(CODEC, rate=Fraction(frame_rate_hz).limit_denominator(1000))
            stream.height, stream.width = frames[0].shape[:2]
            stream.pix_fmt = "yuv420p"  # the one that every browser can show
            stream.options = OPTIONS
            for frame in [*frames, *frames[-1:] * round(HOLD_SECONDS * frame_rate_hz)]:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
        Image.fromarray(np.concatenate([frames[0], frames[-1]], axis=1)).save(
            thumbnail, format="JPEG", quality=JPEG_QUALITY
        )
        unfinished.replace(path)
    except (OSError, av.error.FFmpegError, ValueError) as exc:
        raise ViewingError(
            f"{path}: the video of {record.policy} on {record.task}, seed {record.seed}, could not be "
            f"written ({exc}). Free some space, or capture less; the same command runs it again."
        ) from exc
