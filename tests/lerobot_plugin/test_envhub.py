"""The folder for LeRobot's EnvHub: LeRobot's own functions load its `env.py` and run its environments."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from lerobot.envs import HubEnvConfig, make_env
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, close_envs, preprocess_observation

from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.lerobot_plugin import MikasaEnvConfig

FOLDER = Path(__file__).parents[2] / "plugins" / "envhub_mikasa"
HUB = "owner/mikasa"
SHORT = {"horizon_steps": 4, "cue_steps": 1, "delay_steps": 1}


@dataclass
class Fake(HubEnvConfig):
    hub_path: str | None = HUB
    task: str | None = "RememberColor3-v0"
    simulator: str = "fake"
    env_kwargs: dict[str, Any] = field(default_factory=lambda: SHORT)


@dataclass
class Misspelled(HubEnvConfig):
    hub_path: str | None = HUB
    simulater: str = "fake"


@pytest.fixture(autouse=True)
def hub(monkeypatch: pytest.MonkeyPatch, no_network: None) -> None:
    """The folder is the repository: only the download is replaced."""

    def download(*, repo_id: str, filename: str, **_: Any) -> str:
        assert repo_id == HUB
        return str(FOLDER / filename)

    monkeypatch.setattr("lerobot.envs.utils.hf_hub_download", download)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # what is uploaded is this folder
    monkeypatch.delenv("MIKASA_TASK", raising=False)


def load(cfg: HubEnvConfig | str = HUB, **options: Any) -> dict[str, dict[int, Any]]:
    suites: dict[str, dict[int, Any]] = make_env(cfg, trust_remote_code=True, **options)
    return suites


def two_steps(vector: Any) -> list[dict[str, Any]]:
    n_envs = vector.num_envs
    first, _ = vector.reset(seed=list(range(7, 7 + n_envs)), options={NEW_ROLLOUT_OPTION: True})
    action = np.zeros((n_envs, 7), dtype=np.float32)
    steps = [vector.step(action) for _ in range(2)]
    assert [step[4]["is_success"].tolist() for step in steps] == [[False] * n_envs] * 2
    return [first, *(step[0] for step in steps)]


@pytest.mark.parametrize(
    ("n_envs", "use_async"),
    [(1, False), (2, False), (1, True), pytest.param(2, True, marks=pytest.mark.slow)],
)
def test_lerobot_gets_the_observations_of_env_type_mikasa(n_envs: int, use_async: bool) -> None:
    suites = load(Fake(), n_envs=n_envs, use_async_envs=use_async)
    plugin = MikasaEnvConfig(simulator="fake", env_kwargs=SHORT).create_envs(n_envs)
    vector = suites["mikasa"][0]
    assert type(vector) is (AsyncVectorEnv if use_async and n_envs == 2 else SyncVectorEnv)
    for seen, expected in zip(two_steps(vector), two_steps(plugin["mikasa"][0]), strict=True):
        tensors, theirs = preprocess_observation(seen), preprocess_observation(expected)
        assert {name: tuple(value.shape) for name, value in tensors.items()} == {
            "observation.images.base": (n_envs, 3, 128, 128),
            "observation.images.wrist": (n_envs, 3, 128, 128),
            "observation.state": (n_envs, 10),
        }
        assert all(tensors[name].equal(theirs[name]) for name in theirs)
    assert vector.call("task") == ("RememberColor3-v0",) * n_envs
    close_envs(suites)
    close_envs(plugin)


@pytest.mark.parametrize(
    ("variable", "cfg", "tasks"),
    [
        (None, HUB, ["RememberColor3-v0"]),
        ("RememberColor5-v0", HUB, ["RememberColor5-v0"]),
        ("RememberColor5-v0", Fake(), ["RememberColor3-v0"]),
        ("RememberColor5-v0", Fake(task=None), ["RememberColor5-v0"]),
        ("RememberColor5-v0, RememberColor9-v0", HUB, ["RememberColor5-v0", "RememberColor9-v0"]),
    ],
)
def test_the_task_is_the_configurations_then_the_variables(
    variable: str | None, cfg: Any, tasks: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if variable is not None:
        monkeypatch.setenv("MIKASA_TASK", variable)
    suites = load(cfg)
    assert {number: vector.get_attr("task") for number, vector in suites["mikasa"].items()} == {
        number: (task,) for number, task in enumerate(tasks)
    }
    close_envs(suites)


@pytest.mark.parametrize(
    ("options", "variable", "error", "message"),
    [
        ({}, "RemberColor3-v0", UnknownNameError, "Did you mean 'RememberColor3-v0'"),
        ({}, "", UnknownNameError, "there is no task ''"),
        ({"cfg": Misspelled()}, None, UnknownNameError, "Misspelled: .*Did you mean 'simulator'"),
        ({"cfg": Fake(max_parallel_tasks=2)}, None, RecipeError, "expected 1"),
        ({"n_envs": 0}, None, RecipeError, "n_envs is 0"),
    ],
)
def test_what_cannot_work_is_refused(
    options: dict[str, Any],
    variable: str | None,
    error: type[Exception],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if variable is not None:
        monkeypatch.setenv("MIKASA_TASK", variable)
    with pytest.raises(error, match=message):
        load(**options)


def test_without_the_package_lerobot_shows_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(name: str) -> bool:
        return name == "vla_eval" or name.startswith("vla_eval.")

    class Absent:
        def find_spec(self, name: str, *_: Any) -> None:
            if missing(name):
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    for name in [name for name in sys.modules if missing(name)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Absent(), *sys.meta_path])
    with pytest.raises(ImportError, match=r"vla_eval is not installed.*`make setup`"):
        load()
