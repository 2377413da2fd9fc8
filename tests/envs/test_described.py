"""What a task offers follows from its row and arguments: the same as what its built environment says."""

from typing import Any

import pytest

from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import describe_env, make_env
from vla_eval.errors import TaskArgumentError, UnknownNameError
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.catalog import FAMILIES, OFFICIAL_TASKS, TASKS, task_spec
from vla_eval.tasks.families import FAMILY_TABLE
from vla_eval.tasks.register import env_class
from vla_eval.tasks.source import class_constant
from vla_eval.tasks.spec import TaskSpec

COLOR, ROTATE = "RememberColor3-v0", "RotateStrictPos-v0"
OPEN = {family.id: family.row for family in FAMILY_TABLE}


def is_as_built(settings: EnvSettings) -> bool:
    env = make_env(settings)
    try:
        return describe_env(settings) == env.spec
    finally:
        env.close()


@pytest.mark.parametrize("task", [*TASKS.values(), *FAMILIES.values()], ids=lambda task: task.id)
def test_a_task_on_the_fake_simulator_is_as_described(task: TaskSpec) -> None:
    opened = {name: task_spec(OPEN[task.id]).kwargs[name] for name in task.open_arguments}
    if "angle_range_rad" in opened:
        pytest.skip("the fake simulator has no pegs")
    for kwargs in (opened, {**opened, "horizon_steps": 300, "image_size": 64}):
        assert is_as_built(EnvSettings(task=task.id, kwargs=kwargs, simulator="fake"))


@pytest.mark.parametrize(
    ("task", "kwargs"),
    [
        (COLOR, {}),
        (COLOR, {"robot_uids": "fetch_at_table", "delay_steps": [3, 9], "cue_after_steps": 4}),
        (COLOR, {"control_mode": "pd_joint_pos", "image_size": 64, "horizon_steps": 31}),
        (COLOR, {"robot": "so100"}),
        (COLOR, {"robot": "koch", "control_mode": "pd_joint_delta_pos", "image_size": 32}),
        ("RememberColor", {"n_items": 4, "delay_steps": (10, 200)}),
        ("SeqOfColors", {"n_shown": 7, "gap_steps": 3, "cue_steps": 8}),
        ("BunchOfColors", {"n_shown": 7, "cue_steps": 80}),
        ("ShellGamePick", {"delay_steps": 20}),
        (ROTATE, {}),
        ("TakeItBack-v0", {"horizon_steps": 7}),
    ],
)
def test_a_task_on_maniskill_is_as_described(task: str, kwargs: dict[str, Any]) -> None:
    assert is_as_built(EnvSettings(task=task, kwargs=kwargs))


@pytest.mark.parametrize("task", TASKS.values(), ids=lambda task: task.id)
def test_row_and_source_say_what_the_class_says(task: TaskSpec) -> None:
    cls = env_class(task)
    assert class_constant(task.entry_point, "PROMPT_DIMS") == cls.PROMPT_DIMS


def test_it_takes_no_simulator_to_describe_any_task() -> None:
    for task in (*TASKS.values(), *OFFICIAL_TASKS.values()):
        assert offered_by(task, {}).horizon_steps == task.horizon_steps


REFUSED: list[tuple[str, dict[str, Any], type[Exception], str]] = [
    (COLOR, {"horizon_steps": 8}, TaskArgumentError, "can be 10 together, but the episode ends after"),
    (COLOR, {"delay_step": 20}, UnknownNameError, "Did you mean 'delay_steps'"),
    (COLOR, {"n_colors": 2}, UnknownNameError, "no argument 'n_colors'"),
    (COLOR, {"items": [1]}, UnknownNameError, "no argument 'items'"),
    (COLOR, {"show_cue": "no"}, TaskArgumentError, "'show_cue': expected true or false, found 'no'"),
    (COLOR, {"delay_steps": [9, 2]}, TaskArgumentError, "a pair"),
    (COLOR, {"delay_steps": [1, 60]}, TaskArgumentError, "can be 65 together"),
    (COLOR, {"robot_uids": "fetch"}, UnknownNameError, "Did you mean 'fetch_at_table'"),
    ("ShellGameTouch-v0", {"robot_uids": "fetch_at_table"}, TaskArgumentError, "does not solve ShellGameTou"),
    (
        "ShellGameTouch",
        {"robot": "fetch"},
        TaskArgumentError,
        "Robots that do: panda_wristcam, so100, koch, xarm6, widowx",
    ),
    ("SeqOfColors7-v0", {"cue_steps": 17}, TaskArgumentError, "can be 124 together"),
    ("ShellGameTouch-v0", {"mug": "cup"}, TaskArgumentError, "expected 'primitive' or 'ycb'"),
    ("InterceptMedium-v0", {"delay_steps": 5}, UnknownNameError, "no argument 'delay_steps'"),
    (ROTATE, {"angle_range_rad": 1.0}, TaskArgumentError, "angle_range_rad"),
    (COLOR, {"robot_uids": "fetch_at_table", "control_mode": "pd_ee_pose"}, TaskArgumentError, "this arm"),
]


@pytest.mark.parametrize(("task", "kwargs", "error", "message"), REFUSED)
def test_impossible_arguments_are_refused_before_a_simulator_starts(
    task: str, kwargs: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        describe_env(EnvSettings(task=task, kwargs=kwargs))
