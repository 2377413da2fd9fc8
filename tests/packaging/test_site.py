"""The documentation site: it builds with warnings as errors, is complete, and needs no network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.site_figures import drawn
from tests.page import test_report_browser
from tests.page.test_report_browser import CHROMIUM, Browser
from tests.waiting import wait_until
from vla_eval.cli.main import VERBS
from vla_eval.tasks.catalog import FAMILIES, TASKS

browser = test_report_browser.browser

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


def test_every_module_is_listed_in_its_room(site: Path) -> None:
    page = (site / "reference" / "api" / "rooms.html").read_text(encoding="utf-8")
    rooms = [path.parent for path in (ROOT / "vla_eval").rglob("__init__.py")]
    modules = [file for room in rooms for file in room.glob("*.py") if not file.name.startswith("__")]
    assert page.count("<tr>") >= len(modules) > 300
    assert 'href="episodes.html#vla_eval.core"' in page


def test_each_table_of_results_has_its_figure(site: Path) -> None:
    for name in ("results", "chunk_sizes", "tutorial"):
        source = (ROOT / f"docs/{name}.md").read_text(encoding="utf-8")
        page = (site / f"{name}.html").read_text(encoding="utf-8")
        n_tables = sum(line.startswith("|") and "success once" in line for line in source.split("\n"))
        assert page.count('<figure class="rates">') == n_tables > 0


def test_a_figure_says_what_its_table_says() -> None:
    header = {"policy": "a", "K": "4", "success once": "0.50 [0.25, 0.75]", "chance": "0.33†"}
    rows = [header, {**header, "policy": "b", "success once": "0.40 ± 0.10 [0.20, 0.60]"}]
    figure = drawn(rows)
    assert figure is not None and "ceiling" not in figure and "dashed: chance" in figure
    labels = re.findall(r"<text[^>]*>([^<]+)</text>", figure)
    assert [label for label in labels if not label[0].isdigit()] == ["a", "b"] * 2  # wide and narrow; one K
    assert drawn([{**header, "success once": "250/250"}] * 2) is None
    assert drawn([{"rule": "x"}] * 2) is None


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_pages_from_the_disk_are_searched(site: Path, browser: Browser) -> None:
    browser.call("Emulation.setFocusEmulationEnabled", {"enabled": True})
    browser.open(site / "results.html")
    browser.ask("document.querySelector('.md-search__input').focus()")
    browser.call("Input.insertText", {"text": "wilson"})
    wait_until(lambda: browser.ask("document.querySelectorAll('.md-search-result__link').length"))
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_no_block_of_the_reference_is_cut(site: Path, browser: Browser) -> None:
    cut = "[...document.querySelectorAll('pre code')].filter(one => one.scrollWidth > one.clientWidth).length"
    pages = sorted((site / "reference").rglob("*.html"))
    assert len(pages) > 10
    for page in pages:
        browser.open(page, width=1400)
        assert (page.name, browser.ask(cut)) == (page.name, 0)


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    loads = re.compile(
        r'<(?:script|img|iframe)[^>]+src="(?:https?:)?//|<link[^>]+rel="stylesheet"[^>]+href="https?:'
    )
    assert [
        page.name for page in site.rglob("*.html") if loads.search(page.read_text(encoding="utf-8"))
    ] == []
