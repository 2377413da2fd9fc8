"""What the commands of README and docs read and only a reader has: runs, datasets, checkpoints, a server."""

import functools
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from tests.tasks.made_meshes import folder_of_shapes
from vla_eval.cli.main import main
from vla_eval.config.files import list_recipes
from vla_eval.data.manifest import MIKASA_FOLDER
from vla_eval.results.published.literature import load_published
from vla_eval.tasks.catalog import TASKS
from vla_eval.testing.synthetic import write_synthetic_dataset

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "checkpoints" / "memory_color3"
DEFAULT_TASK = "RememberColor3-v0"
SMALL = ("--episodes", "1", "--workers", "1", "--set", "simulator=fake")
_FOLDER = TemporaryDirectory()


def _made(name: str) -> Path:
    return Path(_FOLDER.name) / name


def _main(*words: str | Path) -> None:
    assert main([str(word) for word in words]) == 0, words


@functools.cache
def recordings(task: str) -> Path:
    """Record a task; return the folder that holds the dataset."""
    folder = _made(f"recorded-{task}")
    episodes = "8" if task == DEFAULT_TASK else "1"
    _main("record", "--task", task, *SMALL, "--episodes", episodes, "--out", folder)
    return folder


def dataset(path: str) -> Path:
    """Return a recording of the task that a path ends with, or a folder that holds one of the default's."""
    last = Path(path).name
    return recordings(last) / last if last in TASKS else recordings(DEFAULT_TASK)


@functools.cache
def run(_: str = "") -> Path:
    """Return a run of the policies that pages compare with."""
    folder = _made("run")
    named = ("memoryless=hold", "memoryless_color3=hold", "memoryless_free=hold")
    policies = ("random", "cue_blind", "oracle", *named)
    own = ("--task", DEFAULT_TASK, "--n-action-steps", "1", "4", "--policy", *policies)
    _main("eval", *own, *SMALL, "--episodes", "2", "--out", folder)
    return folder


@functools.cache
def captured(_: str) -> Path:
    """Return a run with a captured episode."""
    folder = _made("captured")
    own = ("--task", DEFAULT_TASK, "--policy", "oracle", "--capture-rrd", "1", "--capture-video", "1")
    _main("eval", *own, *SMALL, "--out", folder)
    return folder


@functools.cache
def _shards(verb: str) -> None:
    own = ("--task", DEFAULT_TASK, *(("--policy", "oracle") if verb == "eval" else ()))
    for part in ("1/2", "2/2"):
        _main(
            verb,
            *own,
            *SMALL,
            "--episodes",
            "20" if verb == "record" else "2",
            "--shard",
            part,
            "--out",
            _made(verb),
        )


def shard(path: str) -> Path:
    """Return one of the two shards of a run or of a recording."""
    verb = "record" if path.startswith("data/") else "eval"
    _shards(verb)
    found = re.search(r"-(\d+)-of-", path)
    return _made(f"{verb}-shard-{found[1] if found else 1}-of-2")


@functools.cache
def npz(_: str) -> Path:
    """Return a dataset in the paper's layout."""
    folder = _made("npz")
    _main("dataset", "convert", recordings(DEFAULT_TASK) / DEFAULT_TASK, "--to", "npz", "--out", folder)
    return folder


@functools.cache
def mixed(_: str) -> Path:
    """Return a dataset of two tasks."""
    parts = [recordings(task) / task for task in (DEFAULT_TASK, "RememberColor5-v0")]
    _main("dataset", "mix", *parts, "--out", _made("mixed"))
    return _made("mixed")


@functools.cache
def foreign(_: str) -> Path:
    """Return a LeRobot dataset that another program wrote; 0 closes its gripper, 1 opens it."""
    folder = write_synthetic_dataset(_made("foreign"), n_episodes=2, n_frames=13)
    for file in (folder / "data").rglob("*.parquet"):
        frames = pd.read_parquet(file)
        frames["action"] = [np.clip(action, 0, 1) for action in frames["action"]]
        frames.to_parquet(file)
    return folder


@functools.cache
def edited(_: str) -> Path:
    """Return a recording whose own facts an edit has dropped."""
    shutil.copytree(recordings(DEFAULT_TASK) / DEFAULT_TASK, _made("edited"))
    shutil.rmtree(_made("edited") / MIKASA_FOLDER)
    return _made("edited")


@functools.cache
def meshes(_: str) -> Path:
    """Return a folder of ten meshes."""
    return folder_of_shapes(_made("meshes"))


def checkpoint(_: str) -> Path:
    """Return a shipped one."""
    return SHIPPED


STAND_INS: dict[str, Callable[[str], Path]] = {
    r".*-shard-.+-of-.+": shard,
    r"meshes/.*": meshes,
    r"data/npz/.*": npz,
    r"data/mixed": mixed,
    r"data/foreign": foreign,
    r"data/edited": edited,
    r"data/.*": dataset,
    r"view runs/look|report runs/films": captured,
    r"(report|compare|passport|show|view) .*": run,
    r".*": checkpoint,
}
"""Path, or verb and path -> what stands for it; the first that matches counts."""


def put(verb: str, path: str) -> None:
    """Put what a command reads to its path, below the working directory."""
    make = next(
        make
        for pattern, make in STAND_INS.items()
        if re.fullmatch(pattern, path) or re.fullmatch(pattern, f"{verb} {path}")
    )
    for one in [path.replace("*", number) for number in "12"] if make is shard and "*" in path else [path]:
        shutil.copytree(make(one), one)
    if make is checkpoint:
        (Path(path) / "name.txt").write_text(path)  # each is another one


def missing(words: tuple[str, ...]) -> list[str]:
    """Return the paths in a command that a reader has and a test has not; not that of its result."""
    inputs = [word for before, word in zip(("", *words), words, strict=False) if before != "--out"]
    parts = [part for word in inputs if "://" not in word for part in re.split(r"[=,]", word)]
    return [one for one in dict.fromkeys(parts) if _is_path(one) and not Path(one).exists()]


def _is_path(text: str) -> bool:
    looks_so = "/" in text or text.isupper() or text.endswith(".yaml")
    named = (*list_recipes("policies"), *(one.method for one in load_published().results))
    return looks_so and text not in named and not re.fullmatch(r"\d+/\d+", text)
