"""The rules for demonstrations, one row each; docs/datasets.md has the same table (tested)."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_eval.data.checks.demonstrated import Demonstrations
from vla_eval.errors import DatasetError, some_of
from vla_eval.features import ACTION_KEY, DONE_KEY, FPS, SUCCESS_KEY

Answer = Literal["refused", "kept"]
Check = Callable[[Demonstrations], Iterator[str]]
MIN_FRAMES = 2  # lerobot's statistics need two
UNIT_TOLERANCE = 1e-2  # of the length of a unit quaternion; float16 gives 1e-3
BOUND_TOLERANCE = 1e-5  # float32 next to 1 has steps of 1e-7
QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """What is expected, the answer to what breaks it, and what the user can do.

    `check` yields a sentence for each kind of breach: where, expected, found.
    """

    name: str
    answer: Answer
    check: Check
    remedy: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One breach of a rule."""

    rule: Rule
    sentence: str

    def __str__(self) -> str:
        return f"{self.sentence} {self.rule.remedy}".rstrip()


def find_breaches(
    demonstrations: Demonstrations, *, rules: Sequence[Rule] | None = None
) -> tuple[Finding, ...]:
    """Return all breaches of rules, by default of all of them, in their order."""
    return tuple(
        Finding(rule=rule, sentence=sentence)
        for rule in (RULES if rules is None else rules)
        for sentence in rule.check(demonstrations)
    )


def require_sound(demonstrations: Demonstrations, *, rules: Sequence[Rule] | None = None) -> tuple[str, ...]:
    """Return what is kept and should be known of it; arguments as `find_breaches`.

    Raises:
        DatasetError: a rule refuses them; all such breaches are named.
    """
    found = find_breaches(demonstrations, rules=rules)
    refused = [str(one) for one in found if one.rule.answer == "refused"]
    if refused:
        raise DatasetError(f"{demonstrations.where}: {' '.join(refused)}")
    return tuple(str(one) for one in found)


def _frame_rate(what: Demonstrations) -> Iterator[str]:
    if what.fps != FPS and not what.of_an_arm:
        yield f"It has {what.fps:g} frames per second, expected {FPS}: one per control step."


def _image_sizes(what: Demonstrations) -> Iterator[str]:
    sizes = set() if what.of_an_arm else set(what.image_sizes_px.values())
    wanted = {(what.expected_px,) * 2} if what.expected_px else {(size[0],) * 2 for size in sizes}
    if sizes and (sizes != wanted or len(sizes) > 1):
        found = ", ".join(f"{name} {size[0]} × {size[1]}" for name, size in what.image_sizes_px.items())
        expected = f"{what.expected_px} × {what.expected_px}" if what.expected_px else "one square size"
        yield f"The images are {found} (height × width, px), expected {expected}."


def _lengths(what: Demonstrations) -> Iterator[str]:
    short = [
        f"{name} has {length} frames"
        for name, length in zip(what.names, what.lengths, strict=True)
        if length < MIN_FRAMES
    ]
    if short or not what.lengths:
        yield f"{some_of(short) or 'There is no episode'}, expected at least {MIN_FRAMES}."


def _finite(what: Demonstrations) -> Iterator[str]:
    for name, values in what.columns.items():
        if values.dtype.kind == "f" and what.n_frames:
            yield from _numbers(what, name, ~np.isfinite(what.floats(name)), "a finite number")


def _quaternions(what: Demonstrations) -> Iterator[str]:
    for name, names in what.dims.items():
        for begin in range(len(names) - 3):
            if names[begin : begin + 4] == QUATERNION:
                lengths = np.linalg.norm(what.floats(name)[:, begin : begin + 4], axis=1)
                wrong = np.flatnonzero(np.abs(lengths - 1) > UNIT_TOLERANCE)  # NaN is another rule's
                if len(wrong):
                    found = f"of length {lengths[wrong[0]]:.3g}"
                    yield _at(
                        what, wrong, f"the quaternion of {name}", found, "a unit quaternion (w, x, y, z)"
                    )


def _bounds(what: Demonstrations) -> Iterator[str]:
    if what.action is not None and what.n_frames:
        values = what.floats(ACTION_KEY)
        low, high = (np.array(bounds) for bounds in (what.action.low, what.action.high))
        beyond = (values < low - BOUND_TOLERANCE) | (values > high + BOUND_TOLERANCE)
        expected = f"within the bounds of {what.action.control_mode}"
        yield from _numbers(what, ACTION_KEY, beyond & np.isfinite(values), expected)


def _gripper(what: Demonstrations) -> Iterator[str]:
    """Find grippers from 0 to 1; constant commands of 1 are ours, too."""
    if what.action is not None and what.n_frames and not what.is_gripper_named:
        values = what.floats(ACTION_KEY)[:, -1]
        if values.min() == 0 and values.max() <= 1:
            yield (
                f"The gripper's commands ({what.dim(ACTION_KEY, -1)}) are from {values.min():g} to "
                f"{values.max():g}, expected -1 (closed) to 1 (open)."
            )


def _flags(what: Demonstrations) -> Iterator[str]:
    for name in (SUCCESS_KEY, DONE_KEY):
        if name in what.columns and what.n_frames:
            values = what.floats(name)
            yield from _numbers(what, name, (values != 0) & (values != 1) & np.isfinite(values), "0 or 1")


def _sentences(what: Demonstrations) -> Iterator[str]:
    blank = [row for row, sentence in enumerate(what.sentences) if not (sentence or "").strip()]
    if blank:
        yield _at(what, blank, "the language instruction", repr(what.sentences[blank[0]]), "a sentence")


def _one_sentence(what: Demonstrations) -> Iterator[str]:
    changes = [
        first + step
        for first, length in zip(what.firsts.tolist(), what.lengths, strict=True)
        for step in range(1, length if what.sentences else 0)
        if what.sentences[first + step] != what.sentences[first + step - 1]
    ]
    if changes:
        before, after = (what.sentences[row] for row in (changes[0] - 1, changes[0]))
        found = f"{after!r:.100} after {before!r:.100}"
        yield _at(what, changes, "the language instruction", found, "one sentence per episode")


def _plain_sentences(what: Demonstrations) -> Iterator[str]:
    for sentence in dict.fromkeys(one for one in what.sentences if one and one.strip()):
        if sentence != sentence.strip() or not sentence.isprintable():
            yield f"The sentence {sentence!r:.200} has blanks around it or unprintable characters."


def _alike_sentences(what: Demonstrations) -> Iterator[str]:
    by_words: dict[str, set[str]] = {}
    for sentence in dict.fromkeys(what.sentences):
        if sentence is not None:
            by_words.setdefault(" ".join(sentence.casefold().split()).rstrip("."), set()).add(sentence)
    for alike in by_words.values():
        if len(alike) > 1:
            yield f"Sentences differ only in blanks or case: {some_of(map(repr, sorted(alike)))}."


def _done(what: Demonstrations) -> Iterator[str]:
    if DONE_KEY in what.columns and what.n_frames:
        lasts = {int(first) + n - 1 for first, n in zip(what.firsts, what.lengths, strict=True)}
        early = [int(row) for row in np.flatnonzero(what.floats(DONE_KEY)[:, 0] == 1) if row not in lasts]
        if early:
            yield _at(what, early, DONE_KEY, "set", "the last frame of the episode alone to have it")


def _repetitions(what: Demonstrations) -> Iterator[str]:
    seen: dict[str, str] = {}
    again = []
    for name, first, length in zip(what.names, what.firsts.tolist(), what.lengths, strict=True):
        digest = hashlib.sha256()
        for values in what.columns.values():
            digest.update(np.ascontiguousarray(values[first : first + length]).tobytes())
        before = seen.setdefault(digest.hexdigest(), name)
        if before != name and length:
            again.append(f"{name} is {before}")
    if again:
        yield f"Episodes have the same numbers in every frame: {some_of(again)}."


def _refused(name: str, check: Check, remedy: str) -> Rule:
    return Rule(name=name, answer="refused", check=check, remedy=remedy)


def _kept(name: str, check: Check, remedy: str) -> Rule:
    return Rule(name=name, answer="kept", check=check, remedy=remedy)


_FETCH = "Correct it where the dataset was made."
FINITE = _refused("finite numbers", _finite, _FETCH)
"""Before anything is computed of them: clipping would hide what is infinite."""
RULES = (
    _refused(
        f"{FPS} frames per second", _frame_rate, "`mikasa-vla dataset convert … --resample` computes them."
    ),
    _refused(
        "square images of one size",
        _image_sizes,
        "`mikasa-vla dataset convert … --image-size PX` scales square ones, or keeps those of "
        "this size (env.image_size); crop others.",
    ),
    _refused(
        f"at least {MIN_FRAMES} frames per episode",
        _lengths,
        "Delete such episodes (`lerobot-edit-dataset`).",
    ),
    FINITE,
    _refused("unit quaternions", _quaternions, _FETCH),
    _refused(
        "actions within the bounds of their control mode",
        _bounds,
        "The environment would clip them: `mikasa-vla dataset convert … --clip-actions` stores what "
        "it would execute.",
    ),
    _refused(
        "a gripper from -1 (closed) to 1 (open)",
        _gripper,
        "Name them: `mikasa-vla dataset convert … --gripper 0 1` if 0 closes, `--gripper 1 0` "
        "if 1 does, `--gripper -1 1` if they are as expected.",
    ),
    _refused("flags that are 0 or 1", _flags, _FETCH),
    _refused(
        "a sentence in each frame",
        _sentences,
        "Name the task, whose sentence is then used: --task RememberColor3-v0.",
    ),
    _refused(
        "one sentence per episode",
        _one_sentence,
        "Policies here get one instruction per episode: split the episodes where it changes.",
    ),
    _kept(
        "sentences without blanks around them",
        _plain_sentences,
        "A policy is asked with exactly this text only if it is evaluated with it.",
    ),
    _kept("one spelling per sentence", _alike_sentences, "A policy sees different instructions."),
    _kept("done in the last frame alone", _done, ""),
    _kept("different episodes", _repetitions, "They count twice in training."),
)


def _numbers(what: Demonstrations, name: str, wrong: NDArray[np.bool_], expected: str) -> Iterator[str]:
    """Yield one sentence for a field: its first wrong number, and how many frames have one."""
    rows = np.flatnonzero(wrong.any(axis=1))
    if len(rows):
        index = int(wrong[rows[0]].argmax())
        yield _at(what, rows, what.dim(name, index), f"{what.floats(name)[rows[0], index]:g}", expected)


def _at(
    what: Demonstrations, rows: Sequence[int] | NDArray[np.int64], field: str, found: str, expected: str
) -> str:
    more = f" ({len(rows)} frames of {what.n_frames})" if len(rows) > 1 else ""
    return f"{what.place(int(rows[0]))}: {field} is {found}, expected {expected}{more}."
