"""Whether a dataset is complete: a finished recording, import or mixture, whose files are as they were."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from vla_eval.data.dataset_folder import check_dataset, digest_file
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.imported import IMPORT_FILE, ImportFacts, read_import
from vla_eval.data.manifest import MIXTURE_FILE, RECORDING_FILE, DatasetFacts, FileDigest
from vla_eval.data.mixture import MixtureFacts, read_mixture
from vla_eval.errors import DatasetError

RECORDS = (RECORDING_FILE, IMPORT_FILE, MIXTURE_FILE)
"""One of them is in every dataset of this project, written last."""


def check_complete(root: Path) -> DatasetFacts | ImportFacts | MixtureFacts:
    """Return what a dataset says of itself, after comparing all of its files with their digests.

    Raises:
        DatasetError: it is not finished, or files are missing or not what they were.
    """
    check_folder(root)
    if (root / RECORDING_FILE).exists():
        return check_dataset(root)
    imported = read_import(root)
    if imported is not None:
        _check_files(root, imported.files, made="converted", remedy="Convert the source again.")
        return imported
    mixture = read_mixture(root)
    if mixture is None:
        raise DatasetError(
            f"{root}: not a complete dataset of this project: none of {RECORDING_FILE}, {IMPORT_FILE} and "
            f"{MIXTURE_FILE}, which are written last, is there. Run the command that makes it again: a "
            f"recording resumes."
        )
    _check_files(root, mixture.files, made="mixed", remedy="Mix its sources again.")
    return mixture


def files_sha256(files: Mapping[str, FileDigest]) -> str:
    """Return one digest for all files of a dataset."""
    lines = (f"{name}\0{digest.sha256}\n" for name, digest in sorted(files.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _check_files(root: Path, files: Mapping[str, FileDigest], *, made: str, remedy: str) -> None:
    for name, expected in files.items():
        if not (root / name).is_file():
            raise DatasetError(f"{root}: the file {name} is missing. {remedy}")
        if digest_file(root / name) != expected:
            raise DatasetError(f"{root / name}: not what was {made}. {remedy}")
