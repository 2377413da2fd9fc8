"""Whether the video encoder takes a recipe's settings, found before the first seed. Knows no datasets."""

import io
from typing import Any

import av

from vla_eval.errors import RecipeError, did_you_mean
from vla_eval.features import EncoderSettings

SOFTWARE = ("h264", "hevc", "libsvtav1", "libaom-av1")
OF_A_DEVICE = (
    *("h264_videotoolbox", "hevc_videotoolbox", "h264_nvenc", "hevc_nvenc", "h264_vaapi", "h264_qsv"),
    "auto",
)
"""With those above, all that lerobot 0.6.1 takes. Workers may be on a machine that has the device."""
ALIASES = {"av1": "libsvtav1"}  # lerobot's
SIDE_PX, FPS = 128, 20  # of what tasks render
N_COLOURS = 3
N_FRAMES = 4  # x265 sometimes fails to end a video of one or two


def check_encoder(settings: EncoderSettings) -> None:
    """Encode some frames, unless the encoder is a device's; `RecipeError` if it takes no such settings."""
    name = ALIASES.get(settings.vcodec, settings.vcodec)
    known = (*SOFTWARE, *OF_A_DEVICE)
    if name not in known:
        raise RecipeError(
            f"encoder.vcodec is '{name}', expected one of {', '.join(known)}.{did_you_mean(name, known)}"
        )
    if name in OF_A_DEVICE:
        return
    try:
        known_formats = av.Codec(name, "w").video_formats or ()
        formats = [one.name for one in known_formats if len(one.components) == N_COLOURS]
    except av.codec.codec.UnknownCodecError as exc:
        raise RecipeError(
            f"encoder.vcodec: PyAV has no encoder '{name}' on this machine. Choose another one of "
            f"{', '.join(SOFTWARE)}."
        ) from exc
    if settings.pix_fmt not in formats:
        raise RecipeError(
            f"encoder.pix_fmt: '{name}' takes {', '.join(formats)}; found '{settings.pix_fmt}'. Choose one "
            "of these, or another encoder.vcodec. yuv444p keeps the colour of every pixel."
        )
    try:
        _encode_some_frames(name, settings)
    except av.FFmpegError as exc:
        raise RecipeError(
            f"encoder: '{name}' does not take pix_fmt {settings.pix_fmt} with crf {settings.crf} and g "
            f"{settings.g} ({exc}). Change the section `encoder`, or leave it out."
        ) from exc


def _encode_some_frames(name: str, settings: EncoderSettings) -> None:
    options = {"g": str(settings.g), "crf": str(settings.crf)}
    with av.open(io.BytesIO(), "w", format="mp4") as container:
        stream: Any = container.add_stream(name, FPS, options=options)  # Any: a VideoStream
        stream.pix_fmt, stream.width, stream.height = settings.pix_fmt, SIDE_PX, SIDE_PX
        for _ in range(N_FRAMES):
            container.mux(stream.encode(av.VideoFrame(SIDE_PX, SIDE_PX, "rgb24")))
        container.mux(stream.encode())
