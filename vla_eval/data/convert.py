"""Turn demonstrations from one layout into another; `layouts` reads, this writes.

What a source does not have is left out and said so, or is an error; computed is only what follows from
what is there (`import_writer`).
"""

from pathlib import Path
from typing import Any  # arrays of several types

import numpy as np

from vla_eval.data.folder_contents import check_folder
from vla_eval.data.import_writer import ImportWriter
from vla_eval.data.imported import ImportFacts
from vla_eval.data.layouts import Source, SourceEpisode, lerobot_layout, npz_files, read_npz
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError
from vla_eval.features import StateKind
from vla_eval.storage.drafts import whole_folder

NPZ_NAME = "train_data_{}.npz"  # as the authors' recorder calls its files


def find_source(path: Path) -> Source:
    """Say what lies in a folder.

    Raises:
        DatasetError: nothing that can be read.
    """
    check_folder(path)
    if (path / "meta/info.json").is_file():
        layout = lerobot_layout(open_local_dataset(path).meta.features, where=path)
        files = [file for file in sorted(path.rglob("*")) if file.suffix in (".parquet", ".mp4", ".json")]
        return Source(path=path, layout=layout, files=files)
    npz = npz_files(path)
    if not npz:
        raise DatasetError(
            f"{path}: neither a LeRobotDataset (meta/info.json) nor *.npz files. Name the folder of one "
            f"task; docs/dataset_tools.md lists the layouts that can be read."
        )
    first, _ = read_npz(npz[0])
    return Source(path=path, layout="npz_proprio" if first.joints_TD is None else "npz_joints", files=npz)


def convert_to_npz(source: Source, out: Path) -> int:
    """Write the paper's layout, one file per episode; return how many.

    Args:
        source: must have the 25 joints numbers, reward, success and done.
        out: the folder to make.

    Raises:
        DatasetError: `out` exists, or the source lacks something that the layout has.
    """
    n_episodes = 0
    with whole_folder(out, error=DatasetError) as draft:
        draft.mkdir(parents=True)
        for episode in source.episodes():
            arrays = _paper_arrays(episode, where=source.path)
            np.savez_compressed(draft / NPZ_NAME.format(n_episodes), **arrays)
            n_episodes += 1
    return n_episodes


def convert_to_lerobot(source: Source, out: Path, *, task: str | None, state: StateKind) -> ImportFacts:
    """Write a LeRobotDataset with what the source has, under our names.

    Args:
        source: npz files, or the authors' LeRobot release.
        out: the folder to make.
        task: task id; gives the instruction where the source has none.
        state: which proprioception `observation.state` is.

    Raises:
        DatasetError: `out` exists, the source is damaged, or lacks what was asked for.
    """
    if source.layout == "lerobot_mikasa":
        raise DatasetError(f"{source.path}: is a LeRobotDataset of this project already.")
    with whole_folder(out, error=DatasetError) as draft:
        writer = ImportWriter(draft, source, task=task, state=state)
        for episode in source.episodes():
            writer.add(episode)
        return writer.finish()


def _paper_arrays(episode: SourceEpisode, *, where: Path) -> dict[str, Any]:
    numbers = {
        "joints": episode.joints_TD,
        "reward": episode.rewards_T,
        "success": None if episode.success_T is None else episode.success_T.astype(np.int32),
        "done": None if episode.done_T is None else episode.done_T.astype(np.int32),
    }
    missing = [name for name, array in numbers.items() if array is None]
    if missing:
        raise DatasetError(
            f"{where}: {episode.name} has no {', '.join(missing)}, which the paper's layout holds; nothing "
            f"is made up. This source can only be converted with --to lerobot."
        )
    rgb = np.concatenate([episode.images_base_THWC, episode.images_wrist_THWC], axis=-1)
    return {"rgb": rgb, "action": episode.actions_TA, **numbers}
