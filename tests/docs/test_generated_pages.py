"""Pages that a script generates are what it generates, and kept run folders are what they seem."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from vla_eval.results.notes import has_uncommitted_changes
from vla_eval.results.report import build_table
from vla_eval.storage.folders import EPISODES_FILE
from vla_eval.storage.run_file import RUN_FILE
from vla_eval.storage.run_folder import read_run

ROOT = Path(__file__).parents[2]
KEPT = sorted(path.parent for path in (ROOT / "baselines").rglob(RUN_FILE))
MAX_KEPT_BYTES = 20_000_000


def script(name: str) -> ModuleType:
    """Return a script of `scripts/` as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["leaderboard_page", "baselines_page"])
def test_a_generated_page_is_up_to_date(name: str) -> None:
    generated = script(name)
    assert generated.PAGE.read_text(encoding="utf-8") == generated.page(), f"run scripts/{name}.py"


def test_each_kept_run_folder_is_in_one_table() -> None:
    page = script("baselines_page")
    shown = [path for section in page.SECTIONS for path in page.runs_of(section)]
    assert sorted(shown) == KEPT and KEPT


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.name)
def test_a_kept_run_folder_is_whole(path: Path) -> None:
    run = read_run(path)
    assert not [note for note in build_table([run]).notes if "incomplete" in note]
    assert not [record.key for record in run.records if record.outcome == "error"]
    assert not has_uncommitted_changes(run.description.environment), "nobody can make it again"
    for file in path.iterdir():
        assert file.name in (RUN_FILE, EPISODES_FILE), "plan and records are kept, nothing else"
        assert not re.search(r"/(home|root|tmp|mnt|work)/", file.read_text(encoding="utf-8")), file


def test_what_is_kept_stays_small() -> None:
    assert sum(file.stat().st_size for file in (ROOT / "baselines").rglob("*")) < MAX_KEPT_BYTES
