"""A training opens its dataset once: each file of it is read once for its content, and once per digest."""

import builtins
import io
import sys
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from tests.data.second_task import write_second_task
from tests.training import tiny_trainings
from tests.training.tiny_trainings import act
from vla_eval.data.adopt import adopt
from vla_eval.data.derived.mixing import mix_datasets
from vla_eval.data.facts import KINDS
from vla_eval.data.info_file import INFO_FILE
from vla_eval.data.lerobot_tables import STATS_FILE, TASKS_FILE
from vla_eval.data.manifest import FAILED_FILE, IMPORT_FILE, MANIFEST_FILE, MIXTURE_FILE, RECORDING_FILE
from vla_eval.tasks.catalog import task_spec
from vla_eval.training.finetune import finetune

pytestmark = pytest.mark.usefixtures("small_act")
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own

DIGESTS = {
    "digest_file": "whether it is complete",
    "dataset_digest": "whether its frames are decoded",
    "file_sha256": "whether the run is the same",
}
"""Function that reads a file for its digest alone -> what for."""


class Reads:
    """Counts how often the files of a dataset are read for what; videos are left out."""

    def __init__(self, root: Path, patch: pytest.MonkeyPatch) -> None:
        self.root, self.counts = root.resolve(), Counter[tuple[str, str]]()
        for owner, name in ((builtins, "open"), (io, "open"), (pq, "ParquetFile")):
            patch.setattr(owner, name, self._counted(getattr(owner, name)))

    def _counted(self, read: Any) -> Any:
        def counted(file: Any, *args: Any, **options: Any) -> Any:
            path = Path(file).resolve() if isinstance(file, str | Path) else Path()
            if path.is_relative_to(self.root) and path.suffix != ".mp4":
                callers = [frame.f_code.co_name for frame, _ in traceback.walk_stack(sys._getframe())]
                purpose = next((DIGESTS[name] for name in callers if name in DIGESTS), "content")
                self.counts[path.relative_to(self.root).as_posix(), purpose] += 1
            return read(file, *args, **options)

        return counted

    @property
    def content(self) -> set[str]:
        return {name for name, purpose in self.counts if purpose == "content"}


TABLES = {"data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet", str(TASKS_FILE)}
DESCRIPTIONS = {str(INFO_FILE), str(STATS_FILE)}


def trained(root: Path, out: Path, monkeypatch: pytest.MonkeyPatch, **section: Any) -> Reads:
    with monkeypatch.context() as patch:
        reads = Reads(root, patch)
        finetune(act(root, out, **section))
    return reads


@pytest.mark.parametrize("decode_ahead", [True, False])
def test_a_recording_is_read_once(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, decode_ahead: bool
) -> None:
    reads = trained(recorded, tmp_path / "run", monkeypatch, decode_ahead=decode_ahead)
    own = {str(RECORDING_FILE), str(MANIFEST_FILE), str(FAILED_FILE)}
    assert reads.content == TABLES | DESCRIPTIONS | own
    assert {read: n for read, n in reads.counts.items() if n > 1} == {}


@pytest.mark.parametrize("kind", [IMPORT_FILE, MIXTURE_FILE], ids=str)
def test_what_was_not_recorded_here_is_read_once(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Path
) -> None:
    if kind == MIXTURE_FILE:
        root = tmp_path / "mixed"
        mix_datasets([recorded, write_second_task(recorded)], root)
    else:
        root = recorded
        for file in (one.file for one in KINDS):
            (root / file).unlink(missing_ok=True)
        adopt(root, task=task_spec("RememberColor3-v0"))
    reads = trained(root, tmp_path / "run", monkeypatch)
    assert reads.content >= TABLES | DESCRIPTIONS | {str(kind)}
    assert {read: n for read, n in reads.counts.items() if n > 1} == {}
