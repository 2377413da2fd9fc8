"""Write a taped episode as an H.264 mp4 that opens in a browser, and its cue and choice as a JPEG."""

import math
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np
from PIL import Image

from vla_eval.errors import ViewingError
from vla_eval.records import EpisodeRecord
from vla_eval.viz.frames import compose
from vla_eval.viz.moments import find_moments, write_stills
from vla_eval.viz.tape import EpisodeTape

HOLD_SECONDS = 1.0  # the last frame stays, so that the outcome can be read
CUE_SECONDS = 1.0  # a shorter cue is held until then: 0.3 s of three frames are gone before one looks
CODEC: Literal["libx264"] = "libx264"
OPTIONS: dict[str, object] = {"crf": "23", "preset": "veryfast", "threads": "1"}
JPEG_QUALITY = 85


def write_video(
    tape: EpisodeTape,
    record: EpisodeRecord,
    path: Path,
    *,
    thumbnail: Path,
    stills: Path,
    frame_rate_hz: float,
) -> None:
    """Write the captured steps of an episode as an mp4, which is there whole or not at all.

    `thumbnail` is a JPEG of cue and choice, `stills` one of cue, reveal and touch, for `report --filmstrip`.
    `frame_rate_hz` are captured steps per second of the episode.
    """
    captured = tape.captured()
    if not captured:
        raise ViewingError(
            f"{path}: no step of this episode has an image. The environment was made without cameras."
        )
    unfinished = path.with_suffix(".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_stills(tape, stills)
        moments = find_moments(tape)
        n_cue_frames = sum(one.result.status.phase == "cue" for one in captured)
        n_held = max(1, math.ceil(CUE_SECONDS * frame_rate_hz / n_cue_frames)) if n_cue_frames else 1
        repeats = [n_held if one.result.status.phase == "cue" else 1 for one in captured]
        frames = [compose(tape, one, record, n_held=n) for one, n in zip(captured, repeats, strict=True)]
        with av.open(str(unfinished), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = container.add_stream(CODEC, rate=Fraction(frame_rate_hz).limit_denominator(1000))
            stream.height, stream.width = frames[0].shape[:2]
            stream.pix_fmt = "yuv420p"  # the one that every browser can show
            stream.options = OPTIONS
            repeats[-1] += round(HOLD_SECONDS * frame_rate_hz)
            for frame, n_times in zip(frames, repeats, strict=True):
                for _ in range(n_times):
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
        of_poster = [frames[captured.index(one)] for one in (moments.cue, moments.touch)]
        poster = Image.fromarray(np.concatenate(of_poster, axis=1))
        poster.save(thumbnail, format="JPEG", quality=JPEG_QUALITY)
        unfinished.replace(path)
    except (OSError, av.error.FFmpegError, ValueError) as exc:
        raise ViewingError(
            f"{path}: the video of {record.policy} on {record.task}, seed {record.seed}, could not be "
            f"written ({exc}). Free some space, or capture less; the same command runs it again."
        ) from exc
