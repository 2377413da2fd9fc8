"""The moments of an episode that show whether it remembered: cue, reveal, touch."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from vla_eval.config.environment import HUMAN_CAMERA
from vla_eval.core import ImageArray
from vla_eval.viz.tape import EpisodeTape, TapedStep

STILL_PX = 256
JPEG_QUALITY = 90


class Moments(NamedTuple):
    """Captured steps of an episode."""

    cue: TapedStep
    reveal: TapedStep  # the first one of the response phase; without phases, the one in the middle
    touch: TapedStep  # the first one at which a candidate has been touched; else the last one


def find_moments(tape: EpisodeTape) -> Moments:
    """Return the moments of an episode of which at least one step has images."""
    captured = tape.captured()
    response = [one for one in captured if one.result.status.phase == "response"]
    has_phases = captured[0].result.status.phase in ("cue", "delay")
    reveal = response[0] if has_phases and response else captured[len(captured) // 2]
    # Where several candidates are right, the first touch is not the answer yet.
    touched = [
        one
        for one in captured
        if one.result.status.target is not None and one.result.status.first_choice is not None
    ]
    return Moments(cue=captured[0], reveal=reveal, touch=touched[0] if touched else captured[-1])


def write_stills(tape: EpisodeTape, path: Path) -> None:
    """Write the moments side by side as a JPEG, each `STILL_PX` wide, without anything drawn over them."""
    images = [one.result.observation.images for one in find_moments(tape)]
    views = [each[HUMAN_CAMERA] if HUMAN_CAMERA in each else next(iter(each.values())) for each in images]
    size = (STILL_PX, STILL_PX)
    shown = [np.asarray(Image.fromarray(view).resize(size, Image.Resampling.LANCZOS)) for view in views]
    Image.fromarray(np.concatenate(shown, axis=1)).save(path, format="JPEG", quality=JPEG_QUALITY)


def read_stills(path: Path) -> tuple[ImageArray, ...]:
    """Return the moments of `write_stills`, each (STILL_PX, STILL_PX, 3) uint8, scaled if older."""
    n_moments = len(Moments._fields)
    with Image.open(path) as image:
        if image.width != n_moments * image.height:
            raise OSError(f"an image of {image.width} × {image.height} pixels")
        shown = image.convert("RGB").resize((n_moments * STILL_PX, STILL_PX), Image.Resampling.LANCZOS)
    pixels = np.asarray(shown, dtype=np.uint8)
    return tuple(np.split(pixels, n_moments, axis=1))
