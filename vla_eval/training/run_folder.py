"""The folder of a fine-tuning: what it was started with, its metrics, and where it resumes.

    finetune.json   recipe, dataset's digest, run seed, environment; whether its number of steps was changed
    metrics.jsonl   one line per logged step
    train/          lerobot's: checkpoints/000100/{pretrained_model,training_state}, checkpoints/last
    evaluations/    run folders of evaluations on held-out seeds, if asked for

Knows no networks.
"""

import contextlib
import errno
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from vla_eval.checkpoints.files import LAST, step_folders
from vla_eval.config.finetuning import LOGGERS
from vla_eval.errors import TrainingError, VlaEvalError
from vla_eval.storage.durable import on_disk, read_lines, replace_file, whole_lines
from vla_eval.storage.folders import other_files
from vla_eval.storage.run_file import JsonValue, find_changes, listed
from vla_eval.storage.starting import starting
from vla_eval.strict.json_text import Source, read_file, read_json, read_version, shown

FORMAT_VERSION = 1
RUN_FILE, METRICS_FILE, LOG_FILE, TRAIN_FOLDER = "finetune.json", "metrics.jsonl", "train.log", "train"
LOCK_FILE = "finetune.lock"
OWN_FILES = (RUN_FILE, f"{RUN_FILE}.tmp", LOG_FILE, LOCK_FILE)  # of a run without a step
CHECKPOINTS_FOLDER = "checkpoints"
STATE_FOLDER = "training_state"
PARTIAL_PREFIX = ".partial-"
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
"""What systems of files without links answer: exFAT, buckets, some shares."""
COMPARED = "settings"  # what results depend on; the rest is for the record
RECIPE, STEPS = "finetune", "steps"
REQUEST_KEY = "request_sha256"  # see `request.request_sha256`
STEPS_CHANGED = "steps_changed"
"""Of `finetune.json`: each time a run was extended, or shortened before its end."""


logger = logging.getLogger(__name__)


@contextlib.contextmanager
def opened(path: Path, open_it: Callable[[], Path | None]) -> Iterator[Path | None]:
    """Lock the folder of a run, open it, and give the checkpoint to resume from, None at the beginning.

    What a start has made is removed if it fails, or if the block ends with a mistake and without a step.
    """
    with starting(path, own=OWN_FILES, lock_file=LOCK_FILE, purpose="the folder of a fine-tuning") as started:
        resume_from = open_it()
    failed = False
    with on_disk(path):  # outermost: a run that was stopped by a full disk stays
        try:
            yield resume_from
        except VlaEvalError:
            failed = True
            raise
        finally:
            started.leave(failed=failed)


def open_folder(
    path: Path,
    settings: Mapping[str, JsonValue],
    record: Mapping[str, JsonValue],
    *,
    check_steps: Callable[[int, int], None],
    ignore: frozenset[str] = frozenset(),
) -> Path | None:
    """Make the folder of a run, or check that the one there is of the same run; return where it resumes.

    `settings` are what results depend on; `record` are further facts. `check_steps` is called if only the
    number of steps differs, with it and the steps done. Files of `ignore` may lie in an empty folder.
    """
    path.mkdir(parents=True, exist_ok=True)
    names = set(os.listdir(path))
    if names <= ignore:
        _save(path, {COMPARED: settings, **record})
        return None
    if not (path / RUN_FILE).is_file():
        raise other_files(path, names - ignore, missing=RUN_FILE, error=TrainingError)
    known = read_record(path)
    changes = find_changes(_settings(known, path / RUN_FILE), settings, prefix="")
    if [change.path for change in changes] == [f"{RECIPE}.{STEPS}"]:
        _change_steps(path, known, settings, record, check_steps)
    elif changes:
        raise TrainingError(
            f"{path}: this fine-tuning was started with other settings:\n{listed(changes)}\nUse another "
            f"--out, or restore the old settings to resume."
        )
    return newest_checkpoint(path)


def _change_steps(
    path: Path,
    known: dict[str, Any],  # Any: JSON
    settings: Mapping[str, JsonValue],
    record: Mapping[str, JsonValue],
    check_steps: Callable[[int, int], None],
) -> None:
    before, done = known[COMPARED][RECIPE].get(STEPS), newest_step(path)
    if type(before) is not int:
        raise _source(path / RUN_FILE).refuse(f"{STEPS} {shown(before)}", "expected a whole number")
    if done:
        check_steps(before, done)
    entry = {"before": before, "at": done, **{name: record[name] for name in ("environment", "command")}}
    data = {**known, COMPARED: settings, REQUEST_KEY: record[REQUEST_KEY]}
    _save(path, {**data, STEPS_CHANGED: [*known.get(STEPS_CHANGED, ()), entry]})


def _save(path: Path, record: Mapping[str, JsonValue]) -> None:
    data = {"format_version": FORMAT_VERSION, **record}
    replace_file(path / RUN_FILE, f"{json.dumps(data, indent=2, ensure_ascii=False)}\n")


def read_record(path: Path) -> dict[str, Any]:  # Any: JSON
    """Return what a run folder's `finetune.json` holds; nothing if there is none."""
    file = path / RUN_FILE
    if not file.is_file():
        return {}
    source = _source(file)
    data = read_json(read_file(file, source), source)
    read_version(data, "format_version", FORMAT_VERSION, source)
    changes = data.get(STEPS_CHANGED, [])
    if not isinstance(changes, list) or not all(
        isinstance(change, dict) and type(change.get("before")) is int for change in changes
    ):
        raise source.refuse(f"{STEPS_CHANGED} {shown(changes)}", "expected a list of changes, with `before`")
    return data


def newest_checkpoint(path: Path) -> Path | None:
    """Return the newest checkpoint, and remove what a killed run has left half written."""
    folder = path / TRAIN_FOLDER / CHECKPOINTS_FOLDER
    whole = whole_checkpoints(path)
    if not whole:
        # Nothing to resume from: lerobot wants to make its folder itself.
        shutil.rmtree(path / TRAIN_FOLDER, ignore_errors=True)
        (path / METRICS_FILE).unlink(missing_ok=True)
        return None
    for partial in folder.glob(f"{PARTIAL_PREFIX}*"):
        shutil.rmtree(partial)
    point(folder / LAST, whole[-1].name)
    if (path / METRICS_FILE).is_file():  # without the lines of steps that will be run again
        kept = [line for line in read_metrics(path) if line["step"] <= int(whole[-1].name)]
        replace_file(path / METRICS_FILE, "".join(f"{json.dumps(line)}\n" for line in kept))
    return whole[-1]


def whole_checkpoints(path: Path) -> list[Path]:
    """Return the folders of the checkpoints that training can resume from, oldest first."""
    folder = path / TRAIN_FOLDER / CHECKPOINTS_FOLDER
    return [entry for entry in step_folders(folder) if (entry / STATE_FOLDER).is_dir()]


def drop_extra_checkpoints(path: Path, *, save_every_steps: int) -> None:
    """Remove the checkpoints, but the newest, that were written only because a training was stopped."""
    ends = {change["before"] for change in read_record(path).get(STEPS_CHANGED, ())}
    for folder in whole_checkpoints(path)[:-1]:
        if int(folder.name) % save_every_steps and int(folder.name) not in ends:
            partial = folder.with_name(f"{PARTIAL_PREFIX}{folder.name}")
            os.replace(folder, partial)  # a kill leaves nothing that looks like a checkpoint
            shutil.rmtree(partial)


def newest_step(path: Path) -> int:
    """Return how many steps a run folder has checkpoints of; changes nothing, unlike `newest_checkpoint`."""
    whole = whole_checkpoints(path)
    return int(whole[-1].name) if whole else 0


def read_metrics(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of metrics of a run folder; none if there is no file."""
    file = path / METRICS_FILE
    for line, where in whole_lines(read_lines(file), file):
        source = _source(where, "a line of metrics")
        values = read_json(line, source, non_finite=True)  # a loss may be NaN
        if type(values.get("step")) is not int:
            raise source.refuse(f"step {shown(values.get('step'))}", "expected a whole number")
        yield values


def append_metrics(path: Path, line: Mapping[str, float | str]) -> None:
    """Write one line of metrics in a run folder."""
    with (path / METRICS_FILE).open("a", encoding="utf-8") as lines:
        lines.write(f"{json.dumps(dict(line))}\n")


def point(link: Path, target: str) -> None:
    """Let the link name the target, without a moment at which there is no link.

    Where there can be no links, or a folder of that name, there is none: the highest step is the newest.
    """
    if link.is_symlink() and os.readlink(link) == target:
        return
    if link.is_dir() and not link.is_symlink():
        logger.warning("%s: is a folder, not a link. It is left as it is; the highest step is used.", link)
        return
    temporary = link.with_name(f"{link.name}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(target)
        os.replace(temporary, link)
    except OSError as exc:
        if exc.errno not in NO_LINKS:
            raise
        logger.warning("%s: there can be no link here (%s). The highest step is used.", link, exc.strerror)


def _settings(record: dict[str, Any], file: Path) -> dict[str, Any]:  # Any: JSON
    """Return what the run of this `finetune.json` was started with, loggers left out."""
    settings = record.get(COMPARED)
    if not isinstance(settings, dict) or not isinstance(settings.get(RECIPE), dict):
        problem = f"expected a mapping that holds {RECIPE}"
        raise _source(file).refuse(f"{COMPARED} {shown(settings)}", problem)
    recipe = {name: value for name, value in settings[RECIPE].items() if name not in LOGGERS}
    return {**settings, RECIPE: recipe}


def _source(where: Path | str, what: str = "the description of a fine-tuning") -> Source:
    remedy = "The file was changed by something else; restore it, or use another --out."
    return Source(where=str(where), what=what, remedy=remedy, error=TrainingError)
