"""Whether a dataset is complete: a finished recording or import, whose files are as they were."""

from collections.abc import Mapping
from pathlib import Path

from vla_eval.data.dataset_folder import check_dataset, digest_file
from vla_eval.data.imported import IMPORT_FILE, ImportFacts, read_import
from vla_eval.data.manifest import RECORDING_FILE, DatasetFacts, FileDigest
from vla_eval.errors import DatasetError


def check_complete(root: Path) -> DatasetFacts | ImportFacts:
    """Return what a dataset says of itself, after comparing all of its files with their digests.

    Raises:
        DatasetError: it is not finished, or files are missing or not what they were.
    """
    if (root / RECORDING_FILE).exists():
        return check_dataset(root)
    imported = read_import(root)
    if imported is None:
        raise DatasetError(
            f"{root}: not a complete dataset of this project: neither {RECORDING_FILE} nor {IMPORT_FILE}, "
            f"which are written last, is there. Run the command that makes it again: it resumes."
        )
    _check_files(root, imported.files)
    return imported


def _check_files(root: Path, files: Mapping[str, FileDigest]) -> None:
    for name, expected in files.items():
        if not (root / name).is_file():
            raise DatasetError(f"{root}: the file {name} is missing. Convert the source again.")
        if digest_file(root / name) != expected:
            raise DatasetError(f"{root / name}: not what was converted. Convert the source again.")
