"""Give a dataset with our fields, which another tool has edited, the records that training asks for."""

from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval import __version__
from vla_eval.control_modes import EE_DELTA_POSE, MOTORS
from vla_eval.data.check import about_arm, check_videos, demonstrations_of, has_our_fields
from vla_eval.data.checks.demonstrated import Demonstrations
from vla_eval.data.checks.rules import require_sound
from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.derived.mixing import write_statistics
from vla_eval.data.facts import KINDS, ImportedEpisode, ImportFacts
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.foreign.changes import other_sentences
from vla_eval.data.foreign.lerobot_files import names_of
from vla_eval.data.manifest import IMPORT_FILE, write_entry
from vla_eval.data.opening import LocalDataset
from vla_eval.errors import DatasetError
from vla_eval.features import DONE_KEY, STATE_KEY, STATE_NAMES, SUCCESS_KEY, dataset_features
from vla_eval.tasks.spec import TaskSpec


def adopt(root: Path, *, task: TaskSpec | None) -> ImportFacts:
    """Check a dataset, compute its statistics again, and write what it is; return that.

    Replaces `meta/stats.json`, and writes `meta/mikasa/import.json` last. `task` is the demonstrations',
    None if there are several or it is not known.

    Raises:
        DatasetError: it has such records already, has other fields than ours, or breaks a rule.
    """
    check_folder(root)
    for kind in KINDS:
        if (root / kind.file).exists():
            raise DatasetError(
                f"{root}: {kind.file} is there: the dataset has its records, and `mikasa-vla dataset check` "
                "says whether they fit. If another tool has changed files, remove meta/mikasa and adopt it."
            )
    dataset = LocalDataset(root)
    meta = dataset.meta
    demonstrations = demonstrations_of(dataset)
    if not has_our_fields(meta.features) and not demonstrations.of_an_arm:
        raise DatasetError(
            f"{root}: its fields are not those of this project (docs/datasets.md). Import it: mikasa-vla "
            f"dataset convert {root} --to lerobot --out DIR"
        )
    wrong = [said.sentence for said in check_videos(dataset) if said.answer == "refused"]
    if wrong:
        raise DatasetError(f"{root}: {' '.join(wrong)}")
    kept = require_sound(demonstrations)
    without = [camera for camera in meta.video_keys if camera not in (meta.stats or {})]
    if without:
        raise DatasetError(
            f"{root}: meta/stats.json has nothing on {', '.join(without)}. Compute it: lerobot-edit-dataset "
            "--operation.type recompute_stats"
        )
    write_statistics(root, [meta])
    if demonstrations.of_an_arm:
        kept = (*kept, *about_arm(demonstrations))
    facts = _facts(root, demonstrations, meta, task, kept)
    write_entry(root / IMPORT_FILE, facts)
    return facts


def _facts(
    root: Path, what: Demonstrations, meta: Any, task: TaskSpec | None, kept: tuple[str, ...]
) -> ImportFacts:
    mode = MOTORS if what.action is None else what.action.control_mode  # None: `of_an_arm`
    names = names_of(meta.features[STATE_KEY])
    state = next((kind for kind, known in STATE_NAMES.items() if known == names), None)
    ours = (SUCCESS_KEY, DONE_KEY) if state is None else dataset_features(state)
    other = other_sentences(what, task)
    return ImportFacts(
        complete=True,
        source_layout="adopted",
        task=None if task is None else task.id,
        instruction_source="source",
        state=state or MOTORS,
        control_mode=mode,
        executable_by_pd_ee_delta_pose=mode == EE_DELTA_POSE,
        absent=tuple(key for key in ours if key not in meta.features),
        left_out=(),
        n_frames=what.n_frames,
        episodes=tuple(_episode(what, number, first) for number, first in enumerate(what.firsts.tolist())),
        source_files={},
        files=digest_files(root),
        vla_eval_version=__version__,
        is_checked=True,
        converted=("statistics: those of numbers computed from all rows, those of images without quantiles",),
        kept=(*kept, *other),
    )


def _episode(what: Demonstrations, number: int, first: int) -> ImportedEpisode:
    rows = slice(first, first + what.lengths[number])
    success = what.columns.get(SUCCESS_KEY)
    return ImportedEpisode(
        name=what.names[number],
        n_steps=what.lengths[number],
        instruction=str(what.sentences[first]),
        source_seed=None,
        success=None if success is None else bool(np.any(success[rows])),
    )
