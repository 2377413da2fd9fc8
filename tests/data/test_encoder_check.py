"""An encoder that refuses the settings of a recording is found before the first seed."""

import itertools
import subprocess
from pathlib import Path

import av
import numpy as np
import pytest
from lerobot.configs import video
from PIL import Image

from vla_eval.cli.main import main
from vla_eval.data.recording.plan import ALIASES, OF_A_DEVICE, SOFTWARE, check_encoder
from vla_eval.errors import RecipeError
from vla_eval.features import EncoderSettings

FORMATS = ("yuv420p", "yuv422p", "yuv444p", "yuv420p10le", "gbrp", "gray", "rgb24", "rgba", "nv12", "yuv444")


def lerobot_encodes(settings: EncoderSettings, file: Path) -> bool:
    """Whether lerobot takes the settings, and writes a video of two frames with them."""
    try:
        config = video.RGBEncoderConfig(
            vcodec=settings.vcodec, pix_fmt=settings.pix_fmt, crf=settings.crf, g=settings.g
        )
        options = config.get_codec_options(1, as_strings=True)
        with av.open(str(file), "w") as container:
            stream = container.add_stream(config.vcodec, 20, options=options)
            stream.pix_fmt, stream.width, stream.height = config.pix_fmt, 128, 128
            image = Image.fromarray(np.zeros((128, 128, 3), np.uint8))
            for _ in range(4):
                container.mux(stream.encode(av.VideoFrame.from_image(image)))
            container.mux(stream.encode())
    except (ValueError, av.FFmpegError):
        return False
    return True


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("vcodec", "pix_fmt"), list(itertools.product(SOFTWARE, FORMATS)))
def test_what_passes_is_what_lerobot_encodes(vcodec: str, pix_fmt: str, tmp_path: Path) -> None:
    for crf in (0, 12, 63):
        settings = EncoderSettings(vcodec=vcodec, pix_fmt=pix_fmt, crf=crf)
        try:
            check_encoder(settings)
        except RecipeError:
            passed = False
        else:
            passed = True
        assert passed is lerobot_encodes(settings, tmp_path / f"{crf}.mp4"), (crf, passed)


def test_every_encoder_that_lerobot_takes_is_known() -> None:
    assert {*SOFTWARE, *OF_A_DEVICE} == video.VALID_VIDEO_CODECS
    assert ALIASES == video.VIDEO_CODECS_ALIASES


def test_recording_ends_before_its_first_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(subprocess, "Popen", None)  # no worker is started
    arguments = ["record", "--task", "RememberColor3-v0", "--episodes", "2", "--out", str(tmp_path / "d")]
    assert main([*arguments, "--set", "encoder.vcodec=libsvtav1"]) == 1
    message = capsys.readouterr().err
    assert "encoder.pix_fmt: 'libsvtav1' takes yuv420p, yuv420p10le; found 'yuv444p'" in message
    assert not (tmp_path / "d").exists()
    assert main([*arguments, "--set", "encoder.vcodec=h265"]) == 1
    assert "expected one of h264, hevc" in capsys.readouterr().err
