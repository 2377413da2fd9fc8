"""What arguments of a task can be together: planning refuses what the class refuses, in the same words."""

import itertools
import math
import random
from collections.abc import Iterator
from typing import Any, get_args

import pytest
from mani_skill.envs.sapien_env import BaseEnv

from tests.tasks.made_tasks import make
from vla_eval.config.environment import EnvSettings
from vla_eval.control_modes import CONTROL_MODES
from vla_eval.envs.factory import describe_env
from vla_eval.errors import TaskArgumentError, VlaEvalError
from vla_eval.tasks.catalog import TASKS
from vla_eval.tasks.objects.limits import LIMITED
from vla_eval.tasks.register import env_class
from vla_eval.tasks.source import TaskArgument, task_arguments
from vla_eval.tasks.spec import TaskSpec

N_CASES, N_BUILT = 150, 2  # of a task, and of a class
CHOSEN = ("robot_uids", "mug")  # named by a list of their own; a mug may not be installed
VALUES: dict[str, list[Any]] = {
    "bool": [True, False],
    "StepRange": [0, 1, 6, 40, -1, (0, 3), (3, 1), (9, 9), (1, 2, 3), 10_001],
    "Sequence[float]": [
        *[(0.1, 0.2), (0.2, 0.1), (0.0, 1.0), (0.3, 0.3), (0.5,), (0.1, 0.2, 0.3), (0.1, 4.0)],
        *[(3.0, 3.1), (1.0, 11.0), (-1.0, 1.0), (0.05, 1.0), (0.2, math.pi)],
    ],
}
USUAL = {int: [-1, 0, 1, 2, 3, 4, 6, 8, 9, 10], float: [-1, 0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.6]}


def values_of(argument: TaskArgument) -> list[Any]:
    kind = argument.annotation.removesuffix(" | None")
    if argument.name == "control_mode":
        return list(CONTROL_MODES)
    if kind in LIMITED:
        number_type, limits = get_args(LIMITED[kind])
        edges = [limits.least, limits.least - 1, limits.most, limits.most + 1]
        return [number_type(edge) for edge in edges if math.isfinite(edge)] + USUAL[number_type]
    return VALUES.get(kind, [])


def cases(row: TaskSpec) -> Iterator[dict[str, Any]]:
    """One to three arguments of a task with some of the values above, the same ones each time."""
    values = {argument.name: values_of(argument) for argument in task_arguments(row.entry_point)}
    names = sorted(name for name, known in values.items() if known and name not in CHOSEN)
    yield from ({name: value} for name in names for value in values[name])
    rng = random.Random(row.id)
    for size in itertools.islice(itertools.cycle((2, 3)), N_CASES):
        yield {name: rng.choice(values[name]) for name in rng.sample(names, size)}


def refusal(row: TaskSpec, kwargs: dict[str, Any]) -> str | None:
    """What planning says against these arguments, without the name of the task."""
    try:
        describe_env(EnvSettings(task=row.id, kwargs=kwargs))
    except VlaEvalError as exc:
        return str(exc).removeprefix(f"{row.id}: ")
    return None


def begin(self: Any, *_: Any, control_mode: str, **__: Any) -> None:
    """In place of ManiSkill's: no scene is built."""
    self.agent = type("Agent", (), {"control_mode": control_mode})()


@pytest.mark.sampled(8)
@pytest.mark.parametrize("row", TASKS.values(), ids=lambda row: row.id)
def test_planning_refuses_what_the_class_refuses_in_the_same_words(
    row: TaskSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BaseEnv, "__init__", begin)
    kinds = set()
    for kwargs in cases(row):
        planned = refusal(row, kwargs)
        try:
            make(row.id, **kwargs)
        except TaskArgumentError as exc:
            # Of two mistakes either is told first.
            if not any(refusal(row, {name: value}) for name, value in kwargs.items() if len(kwargs) > 1):
                assert planned == str(exc).removeprefix(f"{env_class(row).__name__}: "), kwargs
            assert planned, kwargs
            kinds.add(str(exc).split("=")[0])
        else:  # only planning knows the length of an episode
            assert planned is None or "the episode ends after horizon_steps" in planned, kwargs
    assert kinds


CLASSES = list({row.entry_point: row for row in TASKS.values()}.values())


@pytest.mark.parametrize("row", CLASSES, ids=lambda row: row.id)
def test_the_class_builds_and_begins_what_planning_accepts(row: TaskSpec) -> None:
    together = [kwargs for kwargs in cases(row) if len(kwargs) == 3 and refusal(row, kwargs) is None]
    assert len(together) >= N_BUILT
    for kwargs in together[:N_BUILT]:
        env = make(row.id, **kwargs)
        env.reset(seed=[7])
        env.close()
