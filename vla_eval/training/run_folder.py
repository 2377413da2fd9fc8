"""The folder of a fine-tuning: what it was started with, its metrics, and where it can go on.

    finetune.json   recipe, dataset's digest, run seed, environment
    metrics.jsonl   one line per logged step
    train/          lerobot's: checkpoints/000100/{pretrained_model,training_state}, checkpoints/last
    evaluations/    run folders of evaluations on held-out seeds, if asked for

Standard library only.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vla_eval.errors import TrainingError
from vla_eval.storage.durable import replace_file
from vla_eval.storage.run_file import JsonValue, find_changes

FORMAT_VERSION = 1
RUN_FILE, METRICS_FILE, LOG_FILE, TRAIN_FOLDER = "finetune.json", "metrics.jsonl", "train.log", "train"
CHECKPOINTS_FOLDER, LAST = "checkpoints", "last"
STATE_FOLDER = "training_state"
COMPARED = "settings"  # what results depend on; the rest is for the record


def open_folder(
    path: Path,
    settings: Mapping[str, JsonValue],
    record: Mapping[str, JsonValue],
    *,
    ignore: frozenset[str] = frozenset(),
) -> Path | None:
    """Make the folder of a run, or check that the one that is there is of the same run.

    Args:
        path: the folder.
        settings: what results depend on; must be what it was.
        record: further facts, written once.
        ignore: files that may lie in a folder which is otherwise empty.

    Returns:
        The checkpoint to go on from; None to start from the beginning.

    Raises:
        TrainingError: the folder is somebody else's, or of a run with other settings.
    """
    file = path / RUN_FILE
    path.mkdir(parents=True, exist_ok=True)
    if {entry.name for entry in path.iterdir()} <= ignore:
        data = {"format_version": FORMAT_VERSION, COMPARED: settings, **record}
        replace_file(file, f"{json.dumps(data, indent=2, ensure_ascii=False)}\n")
        return None
    if not file.is_file():
        raise TrainingError(f"{path}: holds other files and no {RUN_FILE}. Use another --out.")
    try:
        before: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))  # Any: JSON
        changes = find_changes(before[COMPARED], settings, prefix="")
    except (ValueError, KeyError, AttributeError) as exc:
        raise TrainingError(f"{file}: not the description of a fine-tuning ({exc!r:.100}).") from exc
    if changes:
        listed = "\n".join(f"  {change}" for change in changes)
        raise TrainingError(
            f"{path}: this fine-tuning was started with other settings:\n{listed}\nUse another --out, or "
            f"restore the old settings to go on."
        )
    return newest_checkpoint(path)


def newest_checkpoint(path: Path) -> Path | None:
    """Return the newest checkpoint, and remove what a killed run has left half written."""
    folder = path / TRAIN_FOLDER / CHECKPOINTS_FOLDER
    whole = whole_checkpoints(path)
    if not whole:
        # Nothing to go on from: lerobot wants to make its folder itself.
        shutil.rmtree(path / TRAIN_FOLDER, ignore_errors=True)
        (path / METRICS_FILE).unlink(missing_ok=True)
        return None
    for partial in folder.glob(".partial-*"):
        shutil.rmtree(partial)
    point(folder / LAST, whole[-1].name)
    _cut_metrics(path / METRICS_FILE, int(whole[-1].name))
    return whole[-1]


def whole_checkpoints(path: Path) -> list[Path]:
    """Return the folders of the checkpoints that training can go on from, oldest first."""
    folder = path / TRAIN_FOLDER / CHECKPOINTS_FOLDER
    return sorted(entry for entry in folder.glob("[0-9]*") if (entry / STATE_FOLDER).is_dir())


def read_metrics(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of metrics of a run folder; none if there is no file."""
    file = path / METRICS_FILE
    if file.is_file():
        for line in file.read_text(encoding="utf-8").splitlines():
            yield json.loads(line)


def point(link: Path, target: str) -> None:
    """Let the link name the target, without a moment at which there is no link."""
    if link.is_symlink() and os.readlink(link) == target:
        return
    temporary = link.with_name(f"{link.name}.tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)


def _cut_metrics(path: Path, step: int) -> None:
    """Drop the lines of steps that will be done again."""
    if not path.is_file():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line)
        except (ValueError, KeyError, TypeError):
            break  # the line that was being written
    replace_file(path, "".join(f"{line}\n" for line in kept))
