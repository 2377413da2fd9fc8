"""Compose the frames of a video: cameras side by side, facts above, where no player's controls are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vla_eval.config.environment import HUMAN_CAMERA
from vla_eval.core import ImageArray
from vla_eval.records import EpisodeRecord
from vla_eval.task_state import Phase
from vla_eval.tasks.objects.item_names import item_names, rgb_of
from vla_eval.viz.tape import EpisodeTape, TapedStep

VIEW_PX = 512  # the large view; the others are half of it, one below the other
WIDTH_PX = VIEW_PX + VIEW_PX // 2
PANEL_PX = 128
LINE_PX = 24
MARGIN_PX = 10
STRIP_PX = 12
PAPER, INK, FAINT = (21, 23, 27), (232, 234, 238), (163, 169, 181)
# Okabe and Ito, as on the report page.
PHASE_COLORS: dict[Phase | None, tuple[int, int, int]] = {
    "cue": (230, 159, 0),
    "delay": (110, 116, 128),
    "response": (86, 180, 233),
    None: (86, 180, 233),  # not shown by the environment
}
SUCCESS_COLOR, FAILURE_COLOR = (47, 196, 154), (255, 138, 61)
SWATCH_PX = 12
UNSEEN = "not seen by the policy: strip, facts, labels and the viewer camera"

Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A piece of a line of text, and the colour of the thing that it names, if it has one."""

    text: str
    swatch: Rgb | None = None


def compose(tape: EpisodeTape, taped: TapedStep, record: EpisodeRecord, *, n_held: int = 1) -> ImageArray:
    """Return one frame of the video, (H, W, 3) uint8 with even sides; it is held for `n_held`."""
    images = taped.result.observation.images
    small = [name for name in images if name != HUMAN_CAMERA]
    canvas = Image.new("RGB", (WIDTH_PX, VIEW_PX + PANEL_PX), PAPER)
    large = HUMAN_CAMERA if HUMAN_CAMERA in images else small[0]
    canvas.paste(_scaled(images[large], VIEW_PX), (0, PANEL_PX))
    draw = ImageDraw.Draw(canvas)
    if large == HUMAN_CAMERA:
        _label(draw, (6, PANEL_PX + 4), "viewer camera, not seen by the policy")
    for row, name in enumerate(small[:2]):
        top = PANEL_PX + row * VIEW_PX // 2
        canvas.paste(_scaled(images[name], VIEW_PX // 2), (VIEW_PX, top))
        _label(draw, (VIEW_PX + 6, top + 4), name)
    _write(draw, tape, taped, record, n_held)
    _draw_strip(draw, tape, taped, record)
    return np.asarray(canvas, dtype=np.uint8)


def _label(draw: ImageDraw.ImageDraw, place: tuple[int, int], text: str) -> None:
    draw.text(place, text, font=_font(13), fill=INK, stroke_width=2, stroke_fill=PAPER)


def _scaled(image: ImageArray, size_px: int) -> Image.Image:
    # Pixels of the policy's cameras stay visible as such: it sees no more than these.
    enlarges = image.shape[0] < size_px
    scaled = Image.fromarray(image)
    how = Image.Resampling.NEAREST if enlarges else Image.Resampling.LANCZOS
    return scaled.resize((size_px, size_px), how)


def _step_parts(tape: EpisodeTape, taped: TapedStep, task: str, n_held: int) -> list[Part]:
    status = taped.result.status
    n_inferences = sum(chunk.step <= taped.step for chunk in tape.chunks)
    is_new = any(chunk.step == taped.step for chunk in tape.chunks)
    texts = [f"step {taped.step}/{tape.start.horizon_steps}"]
    texts += [status.phase] if status.phase else []
    texts += [f"inference {n_inferences}"]
    texts += ["new chunk"] if is_new else []
    texts += [f"held {n_held} x"] if n_held > 1 else []
    parts = [Part(text=text) for text in texts]
    if status.n_candidates:
        names = item_names(task, status.n_candidates, given=status.candidate_names)
        parts += [
            _item_part("target", "several", status.target, names, is_color=not status.candidate_names),
            _item_part("chosen", "none yet", status.first_choice, names, is_color=not status.candidate_names),
        ]
    return parts


def _item_part(kind: str, missing: str, index: int | None, names: Sequence[str], *, is_color: bool) -> Part:
    if index is None:
        return Part(text=f"{kind} {missing}")
    return Part(text=f"{kind} {names[index]}", swatch=rgb_of(names[index]) if is_color else None)


def _write(
    draw: ImageDraw.ImageDraw, tape: EpisodeTape, taped: TapedStep, record: EpisodeRecord, n_held: int
) -> None:
    top = STRIP_PX + 10
    font, bold = _font(17), _font(18)
    episode = (
        f"{record.task}  {record.policy}  K={record.n_action_steps}  run {record.run}  seed {record.seed}"
    )
    lines = ((tape.start.instruction, bold, INK), (episode, font, FAINT))
    for index, (text, fitting, color) in enumerate(lines):
        fitted = _fitted(draw, text, fitting, WIDTH_PX - 2 * MARGIN_PX)
        draw.text((MARGIN_PX, top + index * LINE_PX), fitted, font=fitting, fill=color)
    _write_parts(draw, _step_parts(tape, taped, record.task, n_held), top + 2 * LINE_PX)
    draw.text((MARGIN_PX, top + 3 * LINE_PX + 4), UNSEEN, font=_font(13), fill=FAINT)
    if record.success_step is not None and taped.step >= record.success_step:
        outcome, color = f"SUCCESS at step {record.success_step}", SUCCESS_COLOR
    elif taped.step == tape.steps[-1].step and record.outcome == "failure":
        outcome, color = "FAILURE", FAILURE_COLOR
    else:
        return
    place = (WIDTH_PX - MARGIN_PX - draw.textlength(outcome, font=bold), top + LINE_PX)
    draw.text(place, outcome, font=bold, fill=color)


def _write_parts(draw: ImageDraw.ImageDraw, parts: Sequence[Part], top: int) -> None:
    """Write the pieces of a line, each followed by its swatch, as large as they fit."""
    whole = "  |  ".join(part.text for part in parts)
    left, room = float(MARGIN_PX), WIDTH_PX - 2 * (MARGIN_PX + SWATCH_PX + 5)
    font = next((one for one in map(_font, (17, 15)) if draw.textlength(whole, font=one) <= room), _font(13))
    for number, part in enumerate(parts):
        text = f"  |  {part.text}" if number else part.text
        draw.text((left, top), text, font=font, fill=INK)
        left += draw.textlength(text, font=font)
        if part.swatch is not None:
            place = (left + 5, top + 5, left + 5 + SWATCH_PX, top + 5 + SWATCH_PX)
            draw.rectangle(place, fill=part.swatch, outline=INK)
            left += SWATCH_PX + 5


def _fitted(
    draw: ImageDraw.ImageDraw, text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float
) -> str:
    if draw.textlength(text, font=font) <= width:
        return text
    while text and draw.textlength(f"{text}...", font=font) > width:
        text = text[:-1]
    return f"{text}..."


def _draw_strip(
    draw: ImageDraw.ImageDraw, tape: EpisodeTape, taped: TapedStep, record: EpisodeRecord
) -> None:
    """Draw the episode as a strip: phases, chunk boundaries as ticks, success, and the current step."""
    n_steps = max(tape.start.horizon_steps, 1)
    top, bottom = 2, 2 + STRIP_PX

    def x_of(step: int) -> float:
        return step / n_steps * (WIDTH_PX - 1)

    for one in tape.steps[:-1]:
        color = PHASE_COLORS[one.result.status.phase]
        draw.rectangle((x_of(one.step), top, x_of(one.step + 1), bottom), fill=color)
    for chunk in tape.chunks:
        draw.line((x_of(chunk.step), top + STRIP_PX // 2, x_of(chunk.step), bottom), fill=PAPER)
    if record.success_step is not None:
        x = x_of(record.success_step)
        draw.line((x, top, x, bottom), fill=SUCCESS_COLOR, width=4)
    x = x_of(taped.step)
    draw.line((x, top - 2, x, bottom + 2), fill=INK, width=3)


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)  # it comes with Pillow: no font of the machine is needed
