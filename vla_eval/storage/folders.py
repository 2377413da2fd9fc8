"""Which folder is a run folder, which may become one, and which one may have been meant."""

import os
from collections.abc import Collection
from itertools import islice
from pathlib import Path

from vla_eval.errors import RunFolderError, VlaEvalError, did_you_mean, some_of
from vla_eval.storage.capture_files import EPISODE_FILES
from vla_eval.storage.run_file import RUN_FILE

EPISODES_FILE = "episodes.jsonl"
TIMINGS_FILE = "timings.jsonl"
LOCK_FILE = "run.lock"
LOGS = "logs"
MARKS = "marks"  # images of an evaluation on a real arm
SUBFOLDERS = (LOGS, MARKS, *dict.fromkeys(one.folder for one in EPISODE_FILES))
# What a process that was killed before it wrote run.json may have left behind.
UNSTARTED = frozenset({LOCK_FILE, f"{RUN_FILE}.tmp"})


def check_folder(path: Path) -> None:
    """Refuse a folder that a run cannot go into."""
    check_writable(path)
    if path.exists() and not path.is_dir():
        raise RunFolderError(f"{path}: expected a folder, found a file. Use another --out.")
    for name in SUBFOLDERS:
        _check_subfolder(path / name)
    names = set(os.listdir(path)) if path.exists() else set[str]()
    if RUN_FILE in names or names <= UNSTARTED:
        return
    if EPISODES_FILE in names:
        raise RunFolderError(
            f"{path}: holds {EPISODES_FILE} but no {RUN_FILE}, so nobody knows what its episodes are. "
            f"Restore {RUN_FILE} or use another --out."
        )
    raise other_files(path, names - UNSTARTED, missing=RUN_FILE, error=RunFolderError)


def check_writable(path: Path) -> None:
    """Raise `RunFolderError` if this user may not make or change the folder."""
    whole = path.absolute()
    there = next(one for one in (whole, *whole.parents) if os.path.exists(one))
    if there.is_dir() and not os.access(there, os.W_OK | os.X_OK):
        raise RunFolderError(
            f"{path}: cannot be written into: this user has no permission for {there}. Change that, or name "
            "another folder."
        )


def other_files(
    path: Path, names: Collection[str], *, missing: str, error: type[VlaEvalError]
) -> VlaEvalError:
    """Build the error for a folder that holds other files, and not what is `missing` to be resumed."""
    shown = ", ".join(sorted(names)[:3]) + (", …" if len(names) > 3 else "")
    return error(
        f"{path}: holds other files ({shown}) and no {missing}: nothing is written into it. Use another "
        f"--out."
    )


def _check_subfolder(path: Path) -> None:
    """Raise `RunFolderError` where a run would write into something that is not a folder, or a closed one."""
    if not path.is_dir() and (path.exists() or path.is_symlink()):
        raise RunFolderError(
            f"{path}: expected a folder, found something else. Move it away, or use another --out."
        )
    check_writable(path)


RUN, RECORDING = "run", "recording's state, from which its command resumes"
_FILES = {
    "recording.lock": RECORDING,
    RUN_FILE: RUN,
    "finetune.json": "training",
    "meta/info.json": "dataset",
    "config.json": "checkpoint",
}
_DEEPEST, _MOST = 3, 1000  # levels below a folder, and folders of a level, in which others are looked for


def kind_of(path: Path) -> str | None:
    """Return in words what a folder is; None: nothing that is known here."""
    return next((kind for file, kind in _FILES.items() if os.path.isfile(path / file)), None)


def what_is(path: Path) -> str:
    """Return a sentence for a message: what a folder is, or what lies below it; empty if that is nothing."""
    if kind := kind_of(path):
        return f" It is a {kind}."
    if not os.path.isdir(path):  # also a name that no folder can have
        return ""
    for depth in range(1, _DEEPEST + 1):
        places = sorted(islice(path.glob("*/" * depth), _MOST))
        found = {place: kind for place in places if (kind := kind_of(place)) not in (None, RECORDING)}
        if found:
            kinds = " or ".join(f"{kind}s" for kind in dict.fromkeys(found.values()))
            return f" Below it are {kinds}: {some_of(found)}."
    return ""


def not_a_run_folder(path: Path) -> RunFolderError:
    """Build the error for a folder that is not a run folder, with the ones that may have been meant."""
    if kind := kind_of(path):
        return RunFolderError(f"{path}: is a {kind}, not a run folder: `mikasa-vla eval` makes one.")
    inside = _run_folders(path)
    if inside:
        shown = " ".join(str(path / name) for name in inside[:5])
        return RunFolderError(f"{path}: is not a run folder, but holds some. Name them: {shown}")
    what = f"has no {RUN_FILE}" if path.exists() else "does not exist"
    siblings = _run_folders(path.parent)
    known = f" Run folders in {path.parent}: {', '.join(siblings[:10])}." if siblings else ""
    return RunFolderError(
        f"{path}: is not a run folder: it {what}.{what_is(path)}{did_you_mean(path.name, siblings)}{known} "
        f"`mikasa-vla eval` makes one."
    )


def _run_folders(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in folder.iterdir() if kind_of(entry) == RUN)
    except OSError:  # no folder, or one that may not be looked into: there is nothing to suggest
        return []
