"""How the episodes of a dataset begin: the arm's state and the images of the first frame, in any layout.

Knows nothing of simulators.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vla_eval.config.environment import Simulator
from vla_eval.core import FloatArray, ImageArray
from vla_eval.data.convert import find_source
from vla_eval.data.import_writer import eef_of_proprio
from vla_eval.data.imported import IMPORT_FILE, read_import
from vla_eval.data.layouts import LEROBOT_CAMERAS, Source, SourceEpisode
from vla_eval.data.manifest import RECORDING_FILE, read_facts, read_manifest
from vla_eval.data.mixture import read_mixture
from vla_eval.data.opening import open_local_dataset, read_sample
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError
from vla_eval.features import PROPRIO_KEYS, STATE_KEY, StateKind

Frames = dict[str, ImageArray]
"""Camera -> (H, W, 3) uint8."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialState:
    """How one episode of a dataset begins.

    Attributes:
        name: its number, or its file.
        seed: of its own environment; None if it is not known.
        kind, state: proprioception of the first frame as `features.proprioception` gives it.
    """

    name: str
    seed: int | None
    kind: StateKind
    state: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialStates:
    """How the episodes of a dataset begin.

    Attributes:
        path: the dataset.
        task: task id; None if the dataset names none.
        simulator: that it was recorded with; ManiSkill for what was not recorded here.
        episodes: in the dataset's order.
        read_frames: reads the first frame of each episode; decoding takes a while.
    """

    path: Path
    task: str | None
    simulator: Simulator
    episodes: tuple[InitialState, ...]
    read_frames: Callable[[], list[Frames]]


def read_initial_states(path: Path) -> InitialStates:
    """Read how the episodes of a dataset begin.

    Args:
        path: a dataset of this project, recorded or converted, or what `dataset convert` reads.

    Raises:
        DatasetError: there is no dataset that can be read.
    """
    source = find_source(path)
    if source.layout.startswith("npz"):
        return _of_npz(source)
    return _of_lerobot(source)


def _of_npz(source: Source) -> InitialStates:
    states: list[InitialState] = []
    frames: list[Frames] = []
    for episode in source.episodes():
        kind, state = _state_of(episode)
        states.append(InitialState(name=episode.name, seed=episode.seed, kind=kind, state=state))
        images = (episode.images_base_THWC[0], episode.images_wrist_THWC[0])
        frames.append(dict(zip(("base_camera", "hand_camera"), images, strict=True)))
    return InitialStates(
        path=source.path,
        task=None,
        simulator="maniskill",
        episodes=tuple(states),
        read_frames=lambda: frames,
    )


def _state_of(episode: SourceEpisode) -> tuple[StateKind, FloatArray]:
    if episode.joints_TD is not None:
        return "joints", episode.joints_TD[0]
    assert episode.proprio_TD is not None  # `read_npz` refuses a file without either
    return "eef", eef_of_proprio(episode.proprio_TD[0])


def _of_lerobot(source: Source) -> InitialStates:
    columns = read_columns(source.path)
    first_rows = np.flatnonzero(columns["frame_index"] == 0)
    joints = columns.get(PROPRIO_KEYS["joints"])
    eef = columns.get(PROPRIO_KEYS["eef"])
    seeds, task, simulator = _recorded_facts(source.path, len(first_rows))
    states = []
    for number, row in enumerate(first_rows):
        kind: StateKind = "eef" if joints is None else "joints"
        if joints is not None:
            state = joints[row]
        else:
            state = eef_of_proprio(columns[STATE_KEY][row]) if eef is None else eef[row]
        states.append(
            InitialState(
                name=f"episode {number}", seed=seeds[number], kind=kind, state=state.astype(np.float32)
            )
        )

    def read_frames() -> list[Frames]:
        dataset = open_local_dataset(source.path, return_uint8=True)
        keys = zip(("base_camera", "hand_camera"), LEROBOT_CAMERAS[source.layout], strict=True)
        named = tuple(keys)
        items = (read_sample(dataset, int(row)) for row in first_rows)
        return [{name: item[key].permute(1, 2, 0).numpy() for name, key in named} for item in items]

    return InitialStates(
        path=source.path,
        task=task,
        simulator=simulator,
        episodes=tuple(states),
        read_frames=read_frames,
    )


def _recorded_facts(root: Path, n_episodes: int) -> tuple[Sequence[int | None], str | None, Simulator]:
    """Return seeds, task and simulator as far as `meta/mikasa` knows them.

    Raises:
        DatasetError: the dataset is one of several tasks, whose seeds are episodes of each.
    """
    mixture = read_mixture(root)
    if mixture is not None:
        names = ", ".join(source.name for source in mixture.sources)
        raise DatasetError(
            f"{root}: was mixed of several datasets ({names}). Compare each of those with the evaluation's "
            "episodes of its task: mikasa-vla dataset check-leak DIR"
        )
    seeds: Sequence[int | None] = [None] * n_episodes
    task: str | None = None
    simulator: Simulator = "maniskill"
    if (root / RECORDING_FILE).is_file():
        facts = read_facts(root)
        task = facts.task
        simulator = "fake" if facts.recipe.get("simulator") == "fake" else "maniskill"
        seeds = [episode.seed for episode in read_manifest(root)]
    elif (root / IMPORT_FILE).is_file() and (imported := read_import(root)) is not None:
        task = imported.task
        seeds = [episode.source_seed for episode in imported.episodes]
    if len(seeds) != n_episodes:
        raise DatasetError(
            f"{root}: its tables hold {n_episodes} episodes, meta/mikasa describes {len(seeds)}. Fetch or "
            "record the dataset again."
        )
    return seeds, task, simulator
