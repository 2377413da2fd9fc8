"""Whether a dataset is complete and undamaged: a finished recording, import or mixture, with its digests."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from vla_eval.data.facts import KINDS, DatasetFacts, Facts, find_facts, kind_of, read_facts
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.info_file import INFO_FILE
from vla_eval.data.manifest import FAILED_FILE, MANIFEST_FILE, MIKASA_FOLDER, RECORDING_FILE, FileDigest
from vla_eval.errors import DatasetError
from vla_eval.storage.folders import what_is

# What a dataset consists of; a card, a replay's report and what the Hub's client leaves are not part of it.
CONTENT = (
    "data/**/*.parquet",
    "videos/**/*.mp4",
    "meta/*.json",
    "meta/*.parquet",
    "meta/episodes/**/*.parquet",
)


def check_complete(root: Path) -> Facts:
    """Return what a dataset is, after comparing all of its files with their digests."""
    check_folder(root)
    _check_files(root, facts := require_finished(root))
    return facts


def require_finished(root: Path) -> Facts:
    """Return what a dataset says that it is; its files are not read."""
    facts = find_facts(root)
    if facts is not None:
        return facts
    if not (root / MIKASA_FOLDER).is_dir() and not (root / INFO_FILE).is_file():
        raise DatasetError(
            f"{root}: expected the folder of a dataset, found no {INFO_FILE} in it.{found_or_how(root)}"
        )
    *others, last = (str(kind.file) for kind in KINDS)
    finish = "If another program made it: mikasa-vla dataset check shows how it can be used."
    if (root / MIKASA_FOLDER).is_dir():
        finish = "Run the command that makes it again: a recording resumes."
    raise DatasetError(
        f"{root}: not a complete dataset of this project: none of {', '.join(others)} and {last}, which "
        f"are written last, is there. {finish}"
    )


def found_or_how(root: Path) -> str:
    """Return a sentence for a message: what there is instead of a dataset, or how to make one."""
    how = " `mikasa-vla record` makes datasets; a recording that was stopped is resumed by its command."
    return what_is(root) or how


def check_dataset(root: Path) -> DatasetFacts:
    """Do the same with a recorded dataset."""
    facts = read_facts(root)
    _check_files(root, facts)
    return facts


def _check_files(root: Path, facts: Facts) -> None:
    kind = kind_of(facts)
    for name, expected in facts.files.items():
        file = root / name
        if not file.is_file():
            raise DatasetError(f"{root}: the file {name} is missing. {kind.repair}")
        n_bytes = file.stat().st_size
        if n_bytes != expected.n_bytes:
            raise DatasetError(
                f"{file}: expected {expected.n_bytes} bytes, found {n_bytes}: the file is damaged. "
                f"{kind.repair}"
            )
        if digest_file(file).sha256 != expected.sha256:
            raise DatasetError(f"{file}: its content is not what was {kind.made}. {kind.repair}")


def digest_file(path: Path) -> FileDigest:
    """Return size and sha256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return FileDigest(n_bytes=file.tell(), sha256=digest)


def digest_files(dataset: Path) -> dict[str, FileDigest]:
    """Return path below the dataset -> digest of everything that the dataset consists of."""
    return {name: digest_file(dataset / name) for name in sorted(_content(dataset))}


def _content(dataset: Path) -> Iterable[str]:
    found = {path for pattern in CONTENT for path in dataset.glob(pattern)}
    found |= {dataset / MANIFEST_FILE, dataset / FAILED_FILE}
    found -= {dataset / RECORDING_FILE}
    return (path.relative_to(dataset).as_posix() for path in found if path.is_file())
