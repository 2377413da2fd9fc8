"""Arguments of the tasks: what is impossible or of another type is refused with a reason."""

import math
from typing import Any, get_args

import pytest

from tests.tasks.made_tasks import make
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import make_env
from vla_eval.errors import MissingDependencyError, TaskArgumentError, UnknownNameError
from vla_eval.tasks.arguments import check_arguments
from vla_eval.tasks.catalog import TASKS, task_spec
from vla_eval.tasks.objects.limits import LIMITED, Limits
from vla_eval.tasks.source import task_arguments


@pytest.mark.parametrize(
    ("task", "kwargs", "message"),
    [
        ("RememberColor3-v0", {"n_items": 10}, "n_items=10: expected 2 to 9"),
        ("RememberColor3-v0", {"n_items": 1}, "n_items=1: expected 2 to 9"),
        ("RememberColor3-v0", {"cue_steps": -1}, "cue_steps=-1: expected a whole number of control steps"),
        ("RememberColor3-v0", {"delay_steps": (5, 2)}, "delay_steps="),
        ("RememberColor3-v0", {"goal_threshold_m": 0}, "goal_threshold_m=0: expected a number > 0"),
        ("ShellGameTouch-v0", {"mug": "cup"}, "expected 'primitive' or 'ycb'"),
        ("InterceptMedium-v0", {"velocity_range_m_s": (2, 1)}, "0 < least ≤ most"),
        ("InterceptMedium-v0", {"delay_steps": 5}, "this task has no phases"),
        ("InterceptMedium-v0", {"ball_radius_m": 0}, "ball_radius_m=0: expected > 0 and at most 0.5"),
        ("InterceptGrabMedium-v0", {"lift_height_m": -1}, "lift_height_m=-1: expected 0 to 0.5"),
        ("ShellGamePush-v0", {"goal_threshold_m": 0.2}, "less than push_distance_m=0.1"),
        ("ShellGamePick-v0", {"goal_threshold_m": 0.1}, "less than lift_height_m=0.1"),
        ("ShellGamePick-v0", {"lift_height_m": 2}, "lift_height_m=2: expected > 0 and at most 0.4"),
        ("TakeItBack-v0", {"goal_radius_m": 0.2}, "the cube can lie in the goal region from the start"),
        ("RotateLenientPos-v0", {"angle_range_rad": (0.05, 1)}, "with 0.1 ≤ least ≤ most"),
        ("RotateLenientPos-v0", {"angle_range_rad": (0.1, 4)}, "≤ most ≤ π"),
        ("RotateLenientPos-v0", {"official_signs": True}, "official_signs without signed"),
        ("RotateStrictPos-v0", {"position_threshold_m": 0}, "position_threshold_m=0: expected a number > 0"),
    ],
)
def test_impossible_arguments_are_refused_with_a_reason(
    task: str, kwargs: dict[str, Any], message: str
) -> None:
    with pytest.raises(TaskArgumentError, match=message):
        make(task, **kwargs)


def beyond(limits: Limits) -> list[float]:
    """Numbers that are just too small or too large."""
    below = limits.least if limits.above else limits.least - 1
    return [below] if math.isinf(limits.most) else [below, limits.most + 1]


LIMITED_ARGUMENTS = sorted(
    {
        (task, argument.name, argument.annotation.removesuffix(" | None"))
        for task, row in TASKS.items()
        if not row.is_official
        for argument in task_arguments(row.entry_point)
        if argument.annotation.removesuffix(" | None") in LIMITED
    }
)


def test_a_number_beyond_its_limits_is_refused_before_anything_starts_and_by_the_class_itself() -> None:
    assert {name for _, name, _ in LIMITED_ARGUMENTS} >= {
        "n_items",
        "n_shown",
        "goal_threshold_m",
        "swap_cue",
    }
    asked_of_class = set()
    for task, name, kind in LIMITED_ARGUMENTS:
        row = task_spec(task)
        for number in beyond(get_args(LIMITED[kind])[1]):
            with pytest.raises(TaskArgumentError, match=f"{name}={number}: expected"):
                check_arguments(row, {name: number})
            if (row.entry_point, name, number) not in asked_of_class:
                asked_of_class.add((row.entry_point, name, number))
                with pytest.raises(TaskArgumentError, match=f"{name}={number}: expected"):
                    make(task, **{name: number})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"cue_steps": True}, "cue_steps=True: expected a whole number"),
        ({"delay_steps": [1, 10**9]}, "expected a whole number of control steps"),
        ({"show_cue": "no"}, "'show_cue': expected true or false, found 'no'"),
        ({"goal_threshold_m": "near"}, "'goal_threshold_m': expected a number, found 'near'"),
        ({"n_items": None}, "'n_items': expected a whole number, found None"),
        ({"items": [1]}, "no argument 'items'"),
    ],
)
def test_arguments_of_another_type_are_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises((TaskArgumentError, UnknownNameError), match=message):
        make_env(EnvSettings(task="RememberColor3-v0", kwargs=kwargs))


def test_a_missing_ycb_mug_is_an_error_and_never_a_question(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla_eval.tasks.objects.mug.ASSET_DIR", "nowhere")
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("asked for a download"))
    with pytest.raises(MissingDependencyError, match="download_asset ycb"):
        make("ShellGameTouch-v0", mug="ycb")
