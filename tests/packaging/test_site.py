"""The documentation site: it builds with warnings as errors, is complete, and needs no network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from vla_eval.cli.main import VERBS
from vla_eval.tasks.catalog import FAMILIES, TASKS

ROOT = Path(__file__).parents[2]
QUIET = {"NO_MKDOCS_2_WARNING": "1"}  # an advertisement, printed before the build


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` does it."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, **QUIET})
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_reference_has_every_verb(site: Path) -> None:
    page = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    assert [verb for verb in VERBS if f'id="mikasa-vla-{verb}"' not in page] == []
    assert 'id="mikasa-vla-dataset-convert"' in page


def test_the_reference_has_every_task(site: Path) -> None:
    page = (site / "reference" / "tasks.html").read_text(encoding="utf-8")
    assert [task for task in (*TASKS, *FAMILIES) if f'id="{task.lower()}"' not in page] == []


def test_the_reference_has_what_the_contract_is_made_of(site: Path) -> None:
    page = (site / "reference" / "api" / "episodes.html").read_text(encoding="utf-8")
    for name in ("core.Policy.act", "core.ActionChunk", "specs.PolicySpec", "rollout.rollout"):
        assert f'id="vla_eval.{name}"' in page


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    loads = re.compile(
        r'<(?:script|img|iframe)[^>]+src="(?:https?:)?//|<link[^>]+rel="stylesheet"[^>]+href="https?:'
    )
    assert [
        page.name for page in site.rglob("*.html") if loads.search(page.read_text(encoding="utf-8"))
    ] == []
