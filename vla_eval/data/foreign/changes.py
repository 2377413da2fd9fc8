"""What is converted because the user asks for it; each change returns a sentence for the facts."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from PIL import Image

from vla_eval.config.prompts import instruction_for, load_prompts, sentences_of
from vla_eval.control_modes import ABSOLUTE_MODES
from vla_eval.core import ImageArray
from vla_eval.data.checks.demonstrated import Demonstrations, Numbers
from vla_eval.data.checks.rules import FINITE, require_sound
from vla_eval.data.foreign.episodes import PER_STEP, CameraImages, Source, SourceEpisode
from vla_eval.errors import RecipeError
from vla_eval.features import ACTION_KEY, DONE_KEY, FPS, IMAGE_SIZE_PX, SUCCESS_KEY
from vla_eval.tasks.spec import TaskSpec

MAX_IMAGE_SIZE_PX = 2048
FLAGS = (SUCCESS_KEY, DONE_KEY)


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """What the user asks to be converted.

    Attributes:
        task: whose sentence is used where the source has none.
        image_size_px: height and width that images shall have; None: those of the environment by default.
        gripper: the source's commands that close and that open it; None: as the environment has them.
        resample: compute frames at the environment's rate.
        clip_actions: store what the environment would execute.
    """

    task: TaskSpec | None = None
    image_size_px: int | None = None
    gripper: tuple[float, float] | None = None
    resample: bool = False
    clip_actions: bool = False

    def __post_init__(self) -> None:
        size = self.image_size_px
        if size is not None and not 1 <= size <= MAX_IMAGE_SIZE_PX:
            raise RecipeError(f"--image-size: expected 1 to {MAX_IMAGE_SIZE_PX} px, found {size}.")
        if self.gripper is not None and (
            self.gripper[0] == self.gripper[1] or not np.isfinite(self.gripper).all()
        ):
            raise RecipeError(
                f"--gripper: expected two different numbers, to close and to open, found {self.gripper}."
            )

    @property
    def expected_px(self) -> int:
        """Height and width of the images afterwards."""
        return self.image_size_px or IMAGE_SIZE_PX


def prepare(source: Source, changes: Changes) -> tuple[Source, tuple[str, ...], tuple[str, ...]]:
    """Return the changed source, and sentences on what was converted and kept, if it follows the rules."""
    require_sound(source.demonstrations(expected_px=changes.expected_px), rules=(FINITE,))
    converted = []
    for step in STEPS:
        source, sentence = step(source, changes)
        if sentence:
            converted.append(sentence)
    demonstrations = dataclasses.replace(
        source.demonstrations(expected_px=changes.expected_px), is_gripper_named=changes.gripper is not None
    )
    kept = (*source.remarks, *require_sound(demonstrations), *other_sentences(demonstrations, changes.task))
    return source, tuple(converted), kept


def other_sentences(what: Demonstrations, task: TaskSpec | None) -> tuple[str, ...]:
    """Return a sentence if the instructions are not those with which the task is evaluated."""
    if task is None:
        return ()
    known = sentences_of(load_prompts(), task)
    other = sorted({sentence for sentence in what.sentences if sentence and sentence not in known})
    if not other:
        return ()
    return (
        f"The instruction {other[0]!r:.200} is not the one with which {task.id} is evaluated ({known[0]!r}): "
        "evaluate with a prompt set that has it.",
    )


Step = Callable[[Source, Changes], tuple[Source, str]]


def _fill_sentences(source: Source, changes: Changes) -> tuple[Source, str]:
    missing = sum(not (one or "").strip() for episode in source.episodes for one in episode.sentences)
    if not missing or changes.task is None:
        return source, ""
    sentence = instruction_for(changes.task)

    def filled(episode: SourceEpisode) -> SourceEpisode:
        sentences = tuple(one if (one or "").strip() else sentence for one in episode.sentences)
        return dataclasses.replace(episode, sentences=sentences)

    return _each(source, filled), f"instruction: that of {changes.task.id} in {missing} frames without one"


def _scale_gripper(source: Source, changes: Changes) -> tuple[Source, str]:
    if changes.gripper is None or changes.gripper == (-1, 1):
        return source, ""
    closed, opened = changes.gripper

    def scaled(actions: Numbers) -> Numbers:
        values = actions.astype(np.float64)
        values[:, -1] = 2 * (values[:, -1] - closed) / (opened - closed) - 1
        return values.astype(np.float32)

    said = f"gripper: commands from {closed:g} (closed) to {opened:g} (open) to -1 and 1"
    return _each_action(source, scaled), said


def _resample(source: Source, changes: Changes) -> tuple[Source, str]:
    if not changes.resample or source.fps == FPS:
        return source, ""
    per_frame = Fraction(source.fps) / FPS
    is_absolute = source.action.control_mode in ABSOLUTE_MODES
    changed = tuple(_resampled(episode, per_frame, is_absolute=is_absolute) for episode in source.episodes)
    before, after = (sum(one.n_frames for one in episodes) for episodes in (source.episodes, changed))
    said = (
        f"frame rate: {source.fps:g} to {FPS} frames per second, {before} frames to {after}: the latest "
        "frame at each step, and the movement of each step"
    )
    return dataclasses.replace(source, fps=FPS, episodes=changed), said


def _resampled(episode: SourceEpisode, per_frame: Fraction, *, is_absolute: bool) -> SourceEpisode:
    """Return an episode in which each frame takes `per_frame` frames of the source.

    Nothing is interpolated: an observation is the latest one of the source. A delta action is the movement
    that the source makes during the step, if it moves evenly during each of its own; the gripper's command
    and actions that are a place are those at the step's end.
    """
    n_before = episode.n_frames
    n_frames = -int(-n_before / per_frame // 1)
    begins = [min(step * per_frame, Fraction(n_before)) for step in range(n_frames + 1)]
    latest = np.array([int(begin) for begin in begins[:-1]], dtype=np.int64)
    last = np.array([-int(-begin // 1) - 1 for begin in begins[1:]], dtype=np.int64)
    numbers = {name: values[last if name in PER_STEP else latest] for name, values in episode.numbers.items()}
    if not is_absolute and n_before:
        actions = episode.numbers[ACTION_KEY].astype(np.float64)
        moved = np.concatenate([np.zeros((1, actions.shape[1])), actions.cumsum(axis=0)])
        at_begins = np.stack(
            [np.interp([float(b) for b in begins], np.arange(n_before + 1), dim) for dim in moved.T]
        )
        deltas = np.diff(at_begins, axis=1).T
        deltas[:, -1] = actions[last, -1] if n_frames else 0
        numbers[ACTION_KEY] = deltas.astype(np.float32)

    def read_images() -> CameraImages:
        base, wrist = episode.read_images()
        return base[latest], wrist[latest]

    return dataclasses.replace(
        episode,
        numbers=numbers,
        sentences=tuple(episode.sentences[row] for row in latest),
        read_images=read_images,
    )


def _clip(source: Source, changes: Changes) -> tuple[Source, str]:
    if not changes.clip_actions:
        return source, ""
    actions = np.concatenate([episode.numbers[ACTION_KEY] for episode in source.episodes])
    spec = source.action
    beyond = ((actions < np.array(spec.low)) | (actions > np.array(spec.high))).any(axis=1)
    if not beyond.any():
        return source, ""
    said = (
        f"actions: clipped to the bounds of {spec.control_mode} in {beyond.sum()} of {len(actions)} frames, "
        f"the largest value was {np.abs(actions[beyond]).max():g}"
    )
    return _each_action(source, lambda rows: np.clip(rows, spec.low, spec.high).astype(rows.dtype)), said


def _scale_images(source: Source, changes: Changes) -> tuple[Source, str]:
    size, wanted = source.episodes[0].image_sizes_px[0], changes.expected_px
    if changes.image_size_px is None or size == (wanted, wanted) or size[0] != size[1]:
        return source, ""

    def scaled(episode: SourceEpisode) -> SourceEpisode:
        if any(one != size for one in episode.image_sizes_px):
            return episode  # a rule refuses it

        def read_images() -> CameraImages:
            base, wrist = (_scaled(images, wanted) for images in episode.read_images())
            return base, wrist

        return dataclasses.replace(
            episode, image_sizes_px=((wanted, wanted), (wanted, wanted)), read_images=read_images
        )

    return _each(source, scaled), f"images: {size[0]} × {size[1]} to {wanted} × {wanted}, by area"


def _scaled(images_THWC: ImageArray, size_px: int) -> ImageArray:
    way = Image.Resampling.BOX if size_px < images_THWC.shape[1] else Image.Resampling.BICUBIC
    return np.stack([np.asarray(Image.fromarray(one).resize((size_px, size_px), way)) for one in images_THWC])


def _cast(source: Source, _changes: Changes) -> tuple[Source, str]:
    """Give numbers the types of our fields: float32, and bool for flags."""
    first = source.episodes[0].numbers
    expected = {name: np.dtype(bool if name in FLAGS else np.float32) for name in first}
    differing = [
        f"{name} from {values.dtype} to {expected[name]}"
        for name, values in first.items()
        if any(episode.numbers[name].dtype != expected[name] for episode in source.episodes)
    ]

    def cast(episode: SourceEpisode) -> SourceEpisode:
        return dataclasses.replace(
            episode, numbers={name: _as(rows, expected[name]) for name, rows in episode.numbers.items()}
        )

    return _each(source, cast), f"types: {', '.join(differing)}" if differing else ""


def _as(rows: Numbers, dtype: np.dtype[np.generic]) -> Numbers:
    if dtype.kind == "b" and not np.isin(rows, (0, 1)).all():
        return rows  # a rule refuses them
    with np.errstate(over="ignore"):  # infinite then: a rule refuses it
        return rows.astype(dtype)


STEPS: tuple[Step, ...] = (_fill_sentences, _scale_gripper, _resample, _clip, _scale_images, _cast)
"""In this order: a movement is computed of the source's own, and clipped afterwards."""


def _each(source: Source, what: Callable[[SourceEpisode], SourceEpisode]) -> Source:
    return dataclasses.replace(source, episodes=tuple(what(episode) for episode in source.episodes))


def _each_action(source: Source, what: Callable[[Numbers], Numbers]) -> Source:
    def changed(episode: SourceEpisode) -> SourceEpisode:
        numbers: Mapping[str, Numbers] = {**episode.numbers, ACTION_KEY: what(episode.numbers[ACTION_KEY])}
        return dataclasses.replace(episode, numbers=numbers)

    return _each(source, changed)
