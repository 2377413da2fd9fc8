"""Open a video as the MP4 that it must be. Knows nothing of episodes.

FFmpeg recognises a file by its content, whatever its name: a playlist (HLS, DASH, ffconcat, SDP) opens the
files and addresses that it lists. All playlists are text; an MP4 begins with the size of its first box, whose
high bytes are zero.
"""

from pathlib import Path
from typing import Any  # PyAV's containers

import av

from vla_eval.errors import VlaEvalError

FIRST_BOX = b"ftyp"
MAX_FIRST_BOX_BYTES = 4096  # brands of four bytes each; what encoders write has 20 to 40 bytes
ONLY_THIS_FILE = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2",
    "enable_drefs": "0",
}
"""FFmpeg's options: no network, no other container inside, no tracks in other files."""


def check_mp4(path: Path, error: type[VlaEvalError]) -> None:
    """Raise an error of this class unless a file begins as an MP4 does."""
    try:
        with path.open("rb") as file:
            begin = file.read(8)
    except OSError as exc:
        raise error(f"{path}: the video cannot be read ({exc.strerror}).") from exc
    n_bytes = int.from_bytes(begin[:4])
    if len(begin) < 8 or begin[4:] != FIRST_BOX or not 16 <= n_bytes <= MAX_FIRST_BOX_BYTES:
        raise error(
            f"{path}: expected an MP4 file, found one that begins with {begin!r}. It is not opened. Fetch or "
            "make it again."
        )


def open_mp4(path: Path, error: type[VlaEvalError]) -> Any:  # Any: PyAV's container
    """Return a video, opened to be read; see `check_mp4`, and `av.error.FFmpegError` if it is damaged."""
    check_mp4(path, error)
    return av.open(str(path.absolute()), format="mp4", options=ONLY_THIS_FILE)
