"""What a policy was trained with, compared with what it is asked: one row per fact. Without torch."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from vla_eval.checkpoints.files import TrainingFacts
from vla_eval.control_modes import CONTROL_MODE
from vla_eval.errors import SpecMismatchError, some_of
from vla_eval.models.shared.sentence_reading import quoted
from vla_eval.robots.find import ROBOT
from vla_eval.specs import EnvSpec

WORD = re.compile(r"(\{\w+\})")  # of an instruction: each episode puts its own in its place

Sentences = Mapping[str, Sequence[str]]
"""Task id, `""` where it is not known -> the sentences of its demonstrations."""


class Asked(NamedTuple):
    """What an evaluation asks of a policy; None: not known yet, and not compared."""

    env: EnvSpec  # what the environment offers
    # image fields in the policy's order -> (height_px, width_px)
    images: Mapping[str, tuple[int, int]] | None = None
    state: str | None = None  # which proprioception, or other numbers, it is given


class Compared(NamedTuple):
    """One fact: how it reads from training, how from the evaluation, and what to do where they differ."""

    what: str
    trained: object
    asked: object
    remedy: str


def compared(facts: TrainingFacts, asked: Asked) -> list[Compared]:
    """Return the facts that must not differ; those that are not known on both sides are left out."""
    env, images = asked.env, asked.images or {}
    mode = f"Evaluate it with --set env.{CONTROL_MODE}={facts.control_mode}."
    size = "Set env.image_size, or fine-tune on images of this size."
    cameras = "Correct `cameras` in the recipe's args."
    robot = f"Evaluate it with --set env.{ROBOT}={facts.robot}."
    rows = [
        Compared("robot", facts.robot, env.robot, robot),
        Compared("control mode", facts.control_mode, env.action.control_mode, mode),
        Compared("action dimensions", facts.action_names, env.action.dims, mode),
        Compared(
            "the gripper's number that opens it",
            facts.gripper_open,
            env.action.gripper_open,
            "Convert the demonstrations, and fine-tune on those.",
        ),
        Compared(
            "control steps per second",
            facts.fps,
            env.control_hz,
            "A policy's chunk has one action per control step: fine-tune on demonstrations of this rate.",
        ),
        Compared(
            "images and their order", tuple(facts.images), asked.images and tuple(asked.images), cameras
        ),
        *(
            Compared(f"size of {field}", tuple(facts.images[field]), found, size)
            for field, found in images.items()
            if field in facts.images
        ),
        Compared("state", facts.state, asked.state, "Correct `state` in the recipe's args."),
    ]
    return [row for row in rows if row.trained is not None and row.asked is not None]


def differences(facts: TrainingFacts | None, asked: Asked) -> list[str]:
    """Return a line for each fact that differs: both values, and what to do; none where nothing is known."""
    rows = [] if facts is None else compared(facts, asked)
    return [
        f"{what}: expected {trained}, found {found}. {remedy}"
        for what, trained, found, remedy in rows
        if trained != found
    ]


def refuse_differences(lines: Iterable[str], *, policy: str, task: str) -> None:
    """Raise `SpecMismatchError` with the lines if there are any, for a policy and a task."""
    listed = "\n".join(f"  {line}" for line in lines)
    if listed:
        raise SpecMismatchError(
            f"policy '{policy}' would not be given on {task} what it was trained with:\n{listed}"
        )


def about_sentence(trained: Sentences | None, sentence: str, *, policy: str, task: str) -> str | None:
    """Return a line if a policy is asked with a sentence that it was never trained with; else None."""
    if not trained:
        return None
    known = trained.get(task) or [one for own in trained.values() for one in own]
    pattern = "".join(".+" if WORD.fullmatch(part) else re.escape(part) for part in WORD.split(sentence))
    if any(re.fullmatch(pattern, one, re.DOTALL) for one in known):
        return None
    of = task if trained.get(task) else some_of(name for name in trained if name)
    return (
        f"policy '{policy}' is asked on {task} with a sentence that it was never trained with: "
        f"{quoted(sentence)}. Those of its training ({of or 'of tasks that are not named'}): "
        f"{some_of(quoted(one) for one in dict.fromkeys(known))}. If you do not test a paraphrase, put the "
        "trained sentence into a file in ./prompts/ and name it in prompt_set."
    )


def about_nothing_known(policy: str) -> str:
    """Return a line about a policy of which it is not known with which sentences it was trained."""
    return (
        f"policy '{policy}': with which sentences it was trained is not known (another program or an earlier "
        "version wrote the checkpoint), and not compared."
    )
