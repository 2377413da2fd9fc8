"""Copy a recorded dataset with other actions that lead to the same states: nothing is rendered."""

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vla_eval.config.dataset import OPTION_FIELDS, DatasetRecipe, fingerprint
from vla_eval.config.files import content_of
from vla_eval.core import FloatArray
from vla_eval.data.dataset_folder import check_dataset, digest_files
from vla_eval.data.exact_statistics import vector_statistics
from vla_eval.data.facts import DatasetFacts
from vla_eval.data.info_file import INFO_FILE
from vla_eval.data.lerobot_tables import STATS_FILE
from vla_eval.data.manifest import (
    FAILED_FILE,
    MANIFEST_FILE,
    MIKASA_FOLDER,
    RECORDING_FILE,
    RecordedEpisode,
    read_failed,
    write_entry,
    write_lines,
)
from vla_eval.data.recording.worker import stored_actions
from vla_eval.data.tables import EPISODE_TABLES, FRAME_TABLES, read_table
from vla_eval.errors import DatasetError
from vla_eval.features import ACTION_KEY
from vla_eval.robots.find import action_of
from vla_eval.storage.drafts import draft_path, publish, remove_drafts


def copy_with_actions(
    source: Path, path: Path, episodes: Sequence[RecordedEpisode], recipe: DatasetRecipe
) -> DatasetFacts:
    """Write a dataset with the images and states of another one and other actions; return what it is."""
    if path.exists():
        raise DatasetError(f"{path}: is there already. Name another --out.")
    facts = check_dataset(source)
    remove_drafts(path)
    draft = draft_path(path)
    for name in facts.files:
        if not Path(name).is_relative_to(MIKASA_FOLDER):
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, draft / name)
    _replace_actions(draft, [stored_actions(recipe, episode) for episode in episodes], recipe)
    (draft / MIKASA_FOLDER).mkdir(parents=True)
    write_lines(draft / MANIFEST_FILE, episodes)
    write_lines(draft / FAILED_FILE, read_failed(source))
    changed = dataclasses.replace(
        facts,
        recipe=content_of(recipe, options=OPTION_FIELDS),
        recipe_sha256=fingerprint(recipe),
        files=digest_files(draft),
    )
    write_entry(draft / RECORDING_FILE, changed)
    publish(draft, path)
    return changed


def _replace_actions(root: Path, actions: Sequence[FloatArray], recipe: DatasetRecipe) -> None:
    """Replace the field `action` of a LeRobotDataset: rows, statistics, and their description."""
    names = list(action_of(recipe.env).dims)
    info = json.loads((root / INFO_FILE).read_text(encoding="utf-8"))
    info["features"][ACTION_KEY] |= {"shape": [len(names)], "names": names}
    _write_json(root / INFO_FILE, info)
    rows = np.concatenate(actions)
    stats = json.loads((root / STATS_FILE).read_text(encoding="utf-8"))
    stats[ACTION_KEY] = {name: value.tolist() for name, value in vector_statistics(rows).items()}
    _write_json(root / STATS_FILE, stats)
    _replace_columns(root, FRAME_TABLES, {ACTION_KEY: rows.tolist()})
    by_episode = [vector_statistics(one) for one in actions]
    columns = {
        f"stats/{ACTION_KEY}/{name}": [one[name].tolist() for one in by_episode] for name in by_episode[0]
    }
    _replace_columns(root, EPISODE_TABLES, columns)


def _replace_columns(root: Path, pattern: str, columns: dict[str, list[list[float]]]) -> None:
    """Replace columns of lists in a table that lies in several files, one after the other."""
    first = 0
    for path in sorted(root.glob(pattern)):
        table = read_table(path)
        for name, values in columns.items():
            kind = pa.list_(table.schema.field(name).type.value_type)
            part = pa.array(values[first : first + len(table)], type=kind)
            table = table.set_column(table.schema.get_field_index(name), pa.field(name, kind), part)
        first += len(table)
        pq.write_table(table, path, compression="snappy")


def _write_json(path: Path, data: object) -> None:
    path.write_text(json.dumps(data, indent=4, ensure_ascii=False), encoding="utf-8")
