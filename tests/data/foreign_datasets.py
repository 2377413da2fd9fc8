"""Datasets as other programs leave them: a small good one, and a table of what makes it differ.

Each row changes the tables of a copy, and says what must follow: the same data, other data that is known,
or a refusal that names certain words.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.data.foreign.changes import Changes

LENGTHS = (4, 2, 5)
SENTENCES = ("lift the block", "touch the ball", "lift the block")
N_FRAMES = sum(LENGTHS)
FIRSTS = (0, 4, 6)
BASE, WRIST = "observation.image", "observation.wrist_image"
FRAMES, TASKS = "data/chunk-000/file-000.parquet", "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
SIDE_PX = 128


@dataclass(kw_only=True)
class Known:
    """What a dataset holds, kept apart from its files: what a reader must find, or why it must refuse.

    Attributes:
        action, state: (N, 7) float32.
        success: (N,) flags; None if there are none.
        sentences: (N,) of each frame.
        left_out: fields that have no place in ours.
        refusals: words that one message of a refusal has; empty if the data is right.
    """

    action: np.ndarray
    state: np.ndarray
    success: np.ndarray | None = None
    sentences: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)


def good_data() -> Known:
    rng = np.random.default_rng(5)
    return Known(
        action=rng.uniform(-0.9, 0.9, (N_FRAMES, 7)).astype(np.float32),
        state=rng.uniform(-0.5, 0.5, (N_FRAMES, 7)).astype(np.float32),
        sentences=[sentence for sentence, n in zip(SENTENCES, LENGTHS, strict=True) for _ in range(n)],
    )


def write_good(root: Path, kind: Literal["video", "image"]) -> Path:
    """Write the dataset with the camera names of the authors' release."""
    numbers = {"dtype": "float32", "shape": (7,), "names": None}
    image = {"dtype": kind, "shape": (SIDE_PX, SIDE_PX, 3), "names": ["height", "width", "channel"]}
    dataset = LeRobotDataset.create(
        "local/foreign",
        fps=20,
        root=root,
        features={BASE: image, WRIST: image, "observation.state": numbers, "action": numbers},
    )
    known = good_data()
    row = 0
    for length in LENGTHS:
        for _ in range(length):
            dataset.add_frame(
                {
                    BASE: np.full((SIDE_PX, SIDE_PX, 3), level_of(row), np.uint8),
                    WRIST: np.full((SIDE_PX, SIDE_PX, 3), 255 - level_of(row), np.uint8),
                    "observation.state": known.state[row],
                    "action": known.action[row],
                    "task": known.sentences[row],
                }
            )
            row += 1
        dataset.save_episode()
    dataset.finalize()
    return root


def level_of(row: int) -> int:
    """Return the grey of the base camera in a row."""
    return 40 + 15 * row


class Tables:
    """The files of a dataset, to be changed; written back by `write`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.frames = pd.read_parquet(root / FRAMES)
        self.tasks = pd.read_parquet(root / TASKS)
        self.episodes = pd.read_parquet(root / EPISODES)
        self.info: dict[str, Any] = json.loads((root / "meta/info.json").read_text())

    def write(self) -> None:
        """Write all of them, as pandas does: no metadata of lerobot's."""
        self.frames.to_parquet(self.root / FRAMES)
        self.tasks.to_parquet(self.root / TASKS)
        self.episodes.to_parquet(self.root / EPISODES)
        (self.root / "meta/info.json").write_text(json.dumps(self.info))

    def set_vectors(self, name: str, values: np.ndarray) -> None:
        self.frames[name] = list(values)

    def add_column(self, name: str, values: list[Any], dtype: str, n: int = 1) -> None:
        self.frames[name] = values
        self.info["features"][name] = {"dtype": dtype, "shape": [n], "names": None}


Change = Callable[[Tables, Known, st.DataObject], None]
CHANGES: dict[str, Change] = {}
"""Name -> a function that changes the tables and what a reader must find in them."""
LAST = (
    "numbers_that_are_not_finite",
    "vectors_of_another_length",
    "tasks_in_another_order",
    "columns_that_are_renamed",
    "columns_that_are_missing",
    "cameras_of_other_names",
    "rows_in_another_order",
    "rows_that_are_missing",
    "episodes_that_are_missing",
)
"""After the others and in this order: they move or replace what the others change."""


def in_order(names: list[str]) -> list[str]:
    return sorted(names, key=lambda name: LAST.index(name) if name in LAST else -1)


ASKED: Mapping[str, Changes] = {
    "nothing": Changes(),
    "clip": Changes(clip_actions=True),
    "gripper 0 1": Changes(gripper=(0, 1)),
    "gripper 1 0": Changes(gripper=(1, 0)),
    "gripper as ours": Changes(gripper=(-1, 1)),
}
"""What a user may ask to be converted."""


def change(function: Change) -> Change:
    CHANGES[function.__name__] = function
    return function


def place(row: int) -> str:
    episode = max(number for number, first in enumerate(FIRSTS) if first <= row)
    return f"episode {episode}, frame {row - FIRSTS[episode]}"


@change
def numbers_that_are_not_finite(tables: Tables, known: Known, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["action", "observation.state"]))
    row, dim = data.draw(st.integers(0, N_FRAMES - 1)), data.draw(st.integers(0, 6))
    values = (known.action if name == "action" else known.state).copy()
    values[row, dim] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    tables.set_vectors(name, values)
    field_name = {"action": "action", "observation.state": "proprio.xyz_rpy"}[name]
    # pandas writes NaN as no value.
    known.refusals += [
        f"{place(row)}: {field_name}",
        f"a value in each row of {name}",
    ]


@change
def actions_beyond_the_bounds(tables: Tables, known: Known, data: st.DataObject) -> None:
    factor = data.draw(st.floats(1.5, 1e6))
    known.action = (known.action * np.float32(factor)).astype(np.float32)
    tables.set_vectors("action", known.action)


@change
def grippers_from_0_to_1(tables: Tables, known: Known, data: st.DataObject) -> None:
    commands = data.draw(st.lists(st.sampled_from([0.0, 1.0]), min_size=N_FRAMES, max_size=N_FRAMES))
    known.action[:, 6] = commands
    tables.set_vectors("action", known.action)


@change
def tasks_in_another_order(tables: Tables, known: Known, data: st.DataObject) -> None:
    """Reverse the rows, which keep their numbers: nothing else follows."""
    tables.tasks = tables.tasks.iloc[::-1]


@change
def blank_sentences(tables: Tables, known: Known, data: st.DataObject) -> None:
    blank = data.draw(st.sampled_from(["", "  ", "\t\n"]))
    tables.tasks.index = pd.Index([blank, "touch the ball"], name="task")
    known.refusals.append("episode 0, frame 0: the language instruction")


@change
def sentences_that_change_within_an_episode(tables: Tables, known: Known, data: st.DataObject) -> None:
    row = data.draw(st.sampled_from([row for row in range(N_FRAMES) if row not in FIRSTS]))
    tables.frames.loc[row, "task_index"] = 1 - tables.frames.loc[row, "task_index"]
    known.refusals.append("expected one sentence per episode")


@change
def sentences_that_are_not_there(tables: Tables, known: Known, data: st.DataObject) -> None:
    tables.frames.loc[data.draw(st.integers(0, N_FRAMES - 1)), "task_index"] = data.draw(
        st.sampled_from([-1, 2, 9999])
    )
    known.refusals.append("task_index from 0 to 1")


@change
def flags_as_numbers(tables: Tables, known: Known, data: st.DataObject) -> None:
    dtype = data.draw(st.sampled_from(["float32", "int64", "float64", "bool"]))
    flags = np.array([row + 1 in (*FIRSTS, N_FRAMES) for row in range(N_FRAMES)])
    tables.add_column("next.success", list(flags.astype(dtype)), dtype)
    known.success = flags


@change
def flags_between_0_and_1(tables: Tables, known: Known, data: st.DataObject) -> None:
    row = data.draw(st.integers(0, N_FRAMES - 1))
    flags = np.zeros(N_FRAMES, np.float32)
    flags[row] = data.draw(st.sampled_from([0.5, -1.0, 2.0]))
    tables.add_column("next.done", list(flags), "float32")
    known.refusals.append(f"{place(row)}: next.done")


@change
def columns_that_have_no_place(tables: Tables, known: Known, data: st.DataObject) -> None:
    """Whatever they hold, they are left out, and that is said."""
    values = data.draw(st.lists(st.floats(width=32), min_size=N_FRAMES, max_size=N_FRAMES))
    if np.isnan(values).any():  # pandas writes NaN as no value
        known.refusals.append("a value in each row of observation.torque")
    tables.add_column("observation.torque", [np.float32(value) for value in values], "float32")
    known.left_out.append("observation.torque")


@change
def columns_that_are_renamed(tables: Tables, known: Known, data: st.DataObject) -> None:
    old, new = data.draw(
        st.sampled_from([("action", "actions"), ("observation.state", "observation.states")])
    )
    tables.frames = tables.frames.rename(columns={old: new})
    tables.info["features"][new] = tables.info["features"].pop(old)
    known.refusals.append(f"there is no '{old}'. Did you mean '{new}'")


@change
def columns_that_are_missing(tables: Tables, known: Known, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["action", "observation.state", "timestamp", "task_index", "index"]))
    tables.frames = tables.frames.drop(columns=name, errors="ignore")
    known.refusals.append(name)


@change
def numbers_of_another_type(tables: Tables, known: Known, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["action", "observation.state"]))
    tables.set_vectors(name, (known.action if name == "action" else known.state).astype(np.float64))
    tables.info["features"][name]["dtype"] = "float64"


@change
def vectors_of_another_length(tables: Tables, known: Known, data: st.DataObject) -> None:
    n = data.draw(st.sampled_from([6, 9, 32]))
    tables.set_vectors("action", np.zeros((N_FRAMES, n), np.float32))
    tables.info["features"]["action"]["shape"] = [n]
    known.refusals.append("'action' is")


@change
def names_of_joints(tables: Tables, known: Known, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["action", "observation.state"]))
    names: Any = [f"{data.draw(st.sampled_from(['joint_', 'motor', 'Joint ']))}{i}" for i in range(7)]
    if data.draw(st.booleans()):
        names = {"motors": names}
    tables.info["features"][name]["names"] = names
    known.refusals.append("are those of joints")


@change
def names_that_are_not_there(tables: Tables, known: Known, data: st.DataObject) -> None:
    for camera in (BASE, WRIST):
        tables.info["features"][camera]["names"] = None


@change
def cameras_of_other_names(tables: Tables, known: Known, data: st.DataObject) -> None:
    for table in (tables.frames, tables.episodes):
        table.columns = [name.replace("wrist_image", "hand_image") for name in table.columns]
    tables.info["features"]["observation.hand_image"] = tables.info["features"].pop(WRIST)
    videos = tables.root / "videos" / WRIST
    if videos.exists():
        videos.rename(videos.with_name("observation.hand_image"))
    known.refusals.append("expected the cameras")


@change
def times_off_the_grid(tables: Tables, known: Known, data: st.DataObject) -> None:
    row = data.draw(st.integers(0, N_FRAMES - 1))
    tables.frames.loc[row, "timestamp"] += np.float32(
        data.draw(st.sampled_from([-0.02, 0.001, 0.05, np.nan]))
    )
    known.refusals.append("timestamp")


@change
def another_frame_rate(tables: Tables, known: Known, data: st.DataObject) -> None:
    fps = data.draw(st.sampled_from([5, 10, 15, 30, 50]))
    tables.info["fps"] = fps
    tables.frames["timestamp"] = (tables.frames["frame_index"] / fps).astype(np.float32)
    for camera in (BASE, WRIST):
        for end in ("from", "to"):
            column = f"videos/{camera}/{end}_timestamp"
            if column in tables.episodes:
                tables.episodes[column] *= 20 / fps
    known.refusals.append(f"It has {fps} frames per second, expected 20")


@change
def rows_in_another_order(tables: Tables, known: Known, data: st.DataObject) -> None:
    tables.frames = tables.frames.iloc[::-1].reset_index(drop=True)
    known.refusals.append("index")


@change
def rows_that_are_missing(tables: Tables, known: Known, data: st.DataObject) -> None:
    row = data.draw(st.integers(0, N_FRAMES - 1))
    tables.frames = tables.frames.drop(index=row).reset_index(drop=True)
    known.refusals.append("rows")


@change
def episodes_that_are_missing(tables: Tables, known: Known, data: st.DataObject) -> None:
    number = data.draw(st.integers(0, 1))  # without the last one the rest is a dataset
    tables.frames = tables.frames[tables.frames.episode_index != number].reset_index(drop=True)
    tables.episodes = tables.episodes[tables.episodes.episode_index != number].reset_index(drop=True)
    tables.info["total_episodes"] -= 1
    tables.info["total_frames"] -= LENGTHS[number]
    known.refusals.append("episode")


@change
def episodes_that_overlap(tables: Tables, known: Known, data: st.DataObject) -> None:
    column = data.draw(st.sampled_from(["dataset_from_index", "dataset_to_index"]))
    tables.episodes.loc[1, column] += data.draw(st.sampled_from([-1, 1, 100]))
    known.refusals.append("frames of episode")


@change
def videos_that_overlap(tables: Tables, known: Known, data: st.DataObject) -> None:
    column = f"videos/{BASE}/from_timestamp"
    if column in tables.episodes:
        tables.episodes.loc[1, column] = data.draw(st.sampled_from([0.0, 0.1]))
        known.refusals.append("frames of their own")


@change
def counts_that_are_wrong(tables: Tables, known: Known, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["episodes", "frames", "tasks"]))
    tables.info[f"total_{name}"] += data.draw(st.sampled_from([-1, 1]))
    known.refusals.append(name)


@change
def statistics_of_other_data(tables: Tables, known: Known, data: st.DataObject) -> None:
    """They are computed again."""
    path = tables.root / "meta/stats.json"
    stats = json.loads(path.read_text())
    stats["action"]["mean"] = [7.0] * 7
    path.write_text(json.dumps(stats))
