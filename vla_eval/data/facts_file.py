"""A file in `meta/mikasa/` that says what a dataset is, and is written last. Knows nothing of lerobot."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol  # Any: dataclasses have no common type

from vla_eval.data.manifest import MIKASA_FOLDER, FileDigest, check_file_names
from vla_eval.errors import DatasetError
from vla_eval.storage.durable import replace_file
from vla_eval.strict.json_text import Source, as_dataclass, read_file, read_json, read_version


class Facts(Protocol):
    """What a dataset is; its presence with `complete` marks it as finished."""

    @property
    def complete(self) -> bool:
        """Written as true, after everything else."""

    @property
    def files(self) -> Mapping[str, FileDigest]:
        """Path below the dataset -> digest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FactsFile[F: Facts]:
    """Where facts of one kind lie, and how they are read.

    Attributes:
        cls: a dataclass.
        path: below the dataset.
        version: of its fields; others are refused.
        what: the file is, for messages.
        made_by: `the conversion`, for messages.
        remedy: what to do if it is damaged.
    """

    cls: type[F]
    path: Path
    version: int
    what: str
    made_by: str
    remedy: str

    def write(self, dataset: Path, facts: F) -> None:
        """Write facts, whole or not at all."""
        (dataset / MIKASA_FOLDER).mkdir(parents=True, exist_ok=True)
        plain: Any = facts
        data = {"format_version": self.version, **dataclasses.asdict(plain)}
        replace_file(dataset / self.path, f"{json.dumps(data, indent=2, ensure_ascii=False)}\n")

    def read(self, dataset: Path) -> F | None:
        """Return the facts of a dataset; None if there is no such file.

        Raises:
            DatasetError: the file is damaged, of another version, or the dataset was not finished.
        """
        path = dataset / self.path
        source = Source(
            where=str(path),
            what=self.what,
            remedy=f"The file was changed by another program; {self.remedy}",
            error=DatasetError,
        )
        try:
            data = read_json(read_file(path, source), source)
        except (FileNotFoundError, NotADirectoryError):
            return None
        read_version(data, "format_version", self.version, source)
        facts = as_dataclass(self.cls, data, source)
        check_file_names(facts.files, where=path)
        if not facts.complete:
            raise source.refuse("complete False", f"{self.made_by} did not finish")
        return facts
