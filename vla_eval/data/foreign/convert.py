"""Turn demonstrations from one layout into another: read, change, check, and only then write.

What a source does not have is left out and said so, or is an error; computed is only what follows from
what is there (`import_writer`), or what was asked for (`changes`).
"""

import dataclasses
from pathlib import Path
from typing import Any  # arrays of several types

import numpy as np

from vla_eval.data.checks.rules import require_sound
from vla_eval.data.facts import ImportFacts
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.foreign.changes import Changes, prepare
from vla_eval.data.foreign.episodes import JOINTS_KEY, Source, SourceEpisode
from vla_eval.data.foreign.import_writer import ImportWriter
from vla_eval.data.foreign.lerobot_files import lerobot_source
from vla_eval.data.foreign.npz_files import npz_files, npz_source
from vla_eval.data.info_file import INFO_FILE
from vla_eval.data.manifest import RECORDING_FILE
from vla_eval.data.opening import LocalDataset
from vla_eval.errors import DatasetError
from vla_eval.features import ACTION_KEY, DONE_KEY, REWARD_KEY, SUCCESS_KEY, StateKind
from vla_eval.storage.drafts import whole_folder
from vla_eval.storage.folders import what_is

NPZ_NAME = "train_data_{}.npz"  # as the authors' recorder calls its files
NPZ_FIELDS = {"joints": JOINTS_KEY, "reward": REWARD_KEY, "success": SUCCESS_KEY, "done": DONE_KEY}
NPZ_FLAGS = ("success", "done")


def find_source(path: Path) -> Source:
    """Read the demonstrations in a folder, without their images.

    Raises:
        DatasetError: nothing that can be read.
    """
    check_folder(path)
    if (path / INFO_FILE).is_file():
        return lerobot_source(LocalDataset(path))
    npz = npz_files(path)
    if not npz:
        raise DatasetError(
            f"{path}: neither a LeRobotDataset (meta/info.json) nor *.npz files. Name the folder of one "
            f"task; docs/dataset_tools.md lists the layouts that can be read.{what_is(path)}"
        )
    return npz_source(path, npz)


def convert_to_npz(source: Source, out: Path) -> int:
    """Write the paper's layout, one file per episode; return how many.

    Raises:
        DatasetError: `out` exists, or the source lacks something that the layout has, or breaks a rule.
    """
    demonstrations = source.demonstrations(expected_px=Changes().expected_px)
    require_sound(dataclasses.replace(demonstrations, sentences=()))
    with whole_folder(out, error=DatasetError) as draft:
        draft.mkdir(parents=True)
        for number, episode in enumerate(source.episodes):
            np.savez_compressed(draft / NPZ_NAME.format(number), **_paper_arrays(episode, where=source.path))
    return len(source.episodes)


def convert_to_lerobot(
    source: Source, out: Path, *, state: StateKind, changes: Changes | None = None
) -> ImportFacts:
    """Write a LeRobotDataset with what the source has, under our names, after the changes that are asked for.

    Raises:
        DatasetError: `out` exists, the source is a recording of this project, is damaged, breaks a rule, or
            lacks what was asked for.
    """
    if (source.path / RECORDING_FILE).is_file():
        raise DatasetError(f"{source.path}: is a LeRobotDataset of this project already.")
    changes = changes or Changes()
    source, converted, kept = prepare(source, changes)
    with whole_folder(out, error=DatasetError) as draft:
        writer = ImportWriter(draft, source, task=changes.task, state=state)
        for episode in source.episodes:
            writer.add(episode)
        return writer.finish(converted=converted, kept=kept)


def _paper_arrays(episode: SourceEpisode, *, where: Path) -> dict[str, Any]:
    numbers = {name: episode.numbers.get(field) for name, field in NPZ_FIELDS.items()}
    missing = [name for name, array in numbers.items() if array is None]
    if missing:
        raise DatasetError(
            f"{where}: {episode.name} has no {', '.join(missing)}, which the paper's layout holds; nothing "
            f"is made up. This source can only be converted with --to lerobot."
        )
    types = {name: np.int32 if name in NPZ_FLAGS else np.float32 for name in numbers}
    return {
        "rgb": np.concatenate(episode.read_images(), axis=-1),
        "action": episode.numbers[ACTION_KEY].astype(np.float32),
        **{name: array.astype(types[name]) for name, array in numbers.items() if array is not None},
    }
