"""Tasks of other installed packages: rows by an entry point, run, listed and explained like this one's."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vla_eval.cli.main import main
from vla_eval.config.environment import EnvSettings
from vla_eval.core import SimEnv
from vla_eval.envs.factory import make_env
from vla_eval.errors import PluginError, UnknownNameError
from vla_eval.tasks.catalog import find_task, installed_tasks, task_spec

PACKAGE = "toy-tasks"
CLASS = """
from vla_eval.tasks.remember import RememberColorEnv


class ToyColorEnv(RememberColorEnv):
    FAMILY = 9001

    def __init__(self, *args, n_items: int = 4, patience: int = 7, **kwargs):
        super().__init__(*args, n_items=n_items, **kwargs)
"""
ROW = """
from vla_eval.tasks.spec import TaskSpec

ROW = TaskSpec(
    id="ToyColor-v0",
    version=1,
    entry_point="toy_tasks.color:ToyColorEnv",
    horizon_steps=60,
    memory="object",
    instruction_key="ToyColor",
    instruction="find the cube",
    description="A cube is shown; find it.",
    success="As RememberColor.",
    oracle="vla_eval.oracles.hover:CUBES",
    oracle_sees="poses of all items and which one is right",
    candidates="items",
    candidate_counts={"n_items": 4},
    chance_success=1 / 4,
)
ROWS = [ROW]
TAKEN = [ROW, ROW]
NO_ROW = 3
"""

Install = Callable[[str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a distribution whose entry point is the given attribute, for the time of a test."""

    def installed(attribute: str) -> None:
        site = tmp_path / "site"
        info, package = site / "toy_tasks-1.0.dist-info", site / "toy_tasks"
        for folder in (info, package):
            folder.mkdir(parents=True)
        (package / "__init__.py").write_text(ROW)
        (package / "color.py").write_text(CLASS)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[vla_eval.tasks]\ntoys = {attribute}\n")
        monkeypatch.syspath_prepend(str(site))
        installed_tasks.cache_clear()

    yield installed
    monkeypatch.undo()
    installed_tasks.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "toy_tasks"]:
        del sys.modules[name]


def test_a_task_of_an_installed_package_runs_and_is_listed(
    install: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str], no_network: None
) -> None:
    install("toy_tasks:ROW")
    run = ("--episodes", "2", "--set", "simulator=fake", "--workers", "1", "--out", str(tmp_path / "run"))
    assert main(["eval", "--task", "ToyColor-v0", "--policy", "oracle", "cue_blind", *run]) == 0
    records = [json.loads(line) for line in (tmp_path / "run/episodes.jsonl").read_text().splitlines()]
    assert {(one["task"], one["n_candidates"]) for one in records} == {("ToyColor-v0", 4)}
    assert all(one["success_once"] for one in records if one["policy"] == "oracle")

    capsys.readouterr()
    assert main(["list", "tasks"]) == 0
    listed = capsys.readouterr().out
    assert "of other packages:\n  ToyColor-v0" in listed
    assert "“find the cube”" in listed


def test_it_is_explained_from_the_source_of_its_class(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("toy_tasks:ROWS")
    assert main(["show", "ToyColor-v0"]) == 0
    shown = capsys.readouterr().out
    assert "patience = 7  (ToyColorEnv)" in shown
    assert "delay_steps = 5  (MemoryTableEnv)" in shown


def test_its_class_runs_on_maniskill(install: Install) -> None:
    install("toy_tasks:ROW")
    env: SimEnv = make_env(EnvSettings(task="ToyColor-v0", privileged=True))
    try:
        result = env.reset({0: 1}, render=False)[0]
    finally:
        env.close()
    assert result.status.n_candidates == task_spec("ToyColor-v0").n_candidates({}) == 4
    assert result.observation.privileged is not None
    assert result.observation.privileged.candidate_positions_m.shape == (4, 3)


@pytest.mark.parametrize(
    ("attribute", "problem"),
    [
        ("toy_tasks:GONE", "has no attribute 'GONE'"),
        ("toy_tasks.no_module:ROW", "No module named 'toy_tasks.no_module'"),
        ("toy_tasks:NO_ROW", r"found 3\. Let toy_tasks:NO_ROW be a TaskSpec"),
        ("toy_tasks:TAKEN", "the task id 'ToyColor-v0' is taken"),
    ],
)
def test_what_cannot_be_used_is_an_error_that_names_the_package(
    install: Install, attribute: str, problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    install(attribute)
    with pytest.raises(PluginError, match=rf"the installed package '{PACKAGE}' adds tasks by .*{problem}"):
        task_spec("ToyColor-v0")
    assert task_spec("RememberColor3-v0").n_candidates({}) == 3  # this package's own are still there
    assert main(["list", "tasks"]) == 0
    listed = capsys.readouterr().out
    assert "RememberColor3-v0" in listed
    assert f"CANNOT BE READ: the installed package '{PACKAGE}'" in listed


def test_without_the_package_there_is_no_such_task() -> None:
    assert find_task("ToyColor-v0") is None
    with pytest.raises(UnknownNameError, match="there is no task 'ToyColor-v0'"):
        task_spec("ToyColor-v0")
