"""The report page in a real browser: filters, keys, 30,000 episodes, a phone; no complaint and no request.

Chromium is driven over its DevTools protocol (https://chromedevtools.github.io/devtools-protocol/).
"""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from tests.page.test_report_page import COLOR, Page, episode, full_run, stored
from tests.probe.test_probe_report import PROBE_RUNS
from vla_eval.page.build import write_page
from vla_eval.probe.page.sections import probe_sections
from vla_eval.results.report import build_table
from vla_eval.results.table_columns import lay_out
from vla_eval.storage.capture_files import rrd_file, video_file

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--remote-debugging-port=0",
)
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"),
]


class Browser:
    """One page in Chromium; collects what it complains of and asks for."""

    def __init__(self, address: str) -> None:
        self._socket = connect(address, max_size=None)
        self._numbers = count(1)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        (target,) = [one for one in self.call("Target.getTargets")["targetInfos"] if one["type"] == "page"]
        attach = {"targetId": target["targetId"], "flatten": True}
        self._session: str | None = self.call("Target.attachToTarget", attach)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    _session: str | None = None

    def call(self, method: str, parameters: dict[str, Any] | None = None) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters or {}}
        self._socket.send(json.dumps(message | ({"sessionId": self._session} if self._session else {})))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        if event["method"] in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            self.complaints.append(json.dumps(parameters))
        if event["method"] == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])

    def open(self, page: Path, *, width: int = 1400) -> None:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", size)
        self.call("Page.navigate", {"url": page.as_uri()})
        while self.ask("document.readyState") != "complete" or not self.ask("document.body !== null"):
            pass

    def ask(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", {"expression": expression, "returnByValue": True})["result"].get(
            "value"
        )

    def set(self, name: str, value: str) -> None:
        self.ask(
            f"(() => {{ const field = document.getElementById('episode-filter').elements[{json.dumps(name)}];"
            f"field.value = {json.dumps(value)};"
            "field.dispatchEvent(new Event('input', {bubbles: true})) })()"
        )

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", {"type": kind, "key": key})

    def rows(self, selector: str) -> list[list[str]]:
        found: list[list[str]] = self.ask(
            f"[...document.querySelectorAll({json.dumps(selector)})].map("
            "row => [...row.cells].map(cell => cell.textContent))"
        )
        return found


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "about:blank"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            lines = (re.search(r"ws://\S+", line) for line in process.stderr)
            address = next(found[0] for found in lines if found)
            yield Browser(address)
        finally:
            process.kill()


def test_the_page_is_shown_without_complaint_and_without_a_request(browser: Browser, tmp_path: Path) -> None:
    run = full_run()
    page = write_page([run], tmp_path / "page")
    browser.open(page)
    read = Page(browser.ask("document.documentElement.outerHTML"))  # the browser's own reading of the page
    assert read.rows[1:] == [list(row) for row in lay_out(build_table([run])).rows]
    assert browser.ask("document.querySelectorAll('svg[role=img]').length") >= 4
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith("data:")] == [page.as_uri()]


def test_episodes_are_filtered(browser: Browser, tmp_path: Path) -> None:
    browser.open(write_page([full_run()], tmp_path / "page"))
    n_all = len(full_run().records)
    assert (
        browser.ask("document.getElementById('episode-count').textContent") == f"{n_all} of {n_all} episodes"
    )
    browser.set("policy", "random")
    browser.set("outcome", "success")
    # `random` succeeds at seed 0, at each of two K.
    assert [row[1:6] for row in browser.rows("#episode-table tbody tr")] == [
        ["random", k, "0", "0", "success"] for k in ("1", "4")
    ]
    browser.set("policy", "")
    browser.set("outcome", "")
    browser.set("error", "WorkerCrashed")
    assert [row[4:6] for row in browser.rows("#episode-table tbody tr")] == [["6", "error"]]


def test_arrow_keys_show_the_same_seed_of_all_policies(browser: Browser, tmp_path: Path) -> None:
    browser.open(write_page([full_run()], tmp_path / "page"))
    browser.set("task", COLOR)
    browser.ask("document.getElementById('episode-list').focus()")
    for key in ("ArrowDown", "ArrowDown", "ArrowDown", "ArrowUp"):
        browser.press(key)
    (chosen,) = browser.rows("#episode-table tbody tr[aria-selected]")
    assert chosen[1:5] == ["p", "1", "0", "1"]  # the second row: seed 1 of p at K = 1
    headings, *beside = browser.rows("#episode-beside tr")
    assert headings == ["policy", "K", "outcome", "success step", "target", "first choice"]
    assert [row[:2] for row in beside] == [["p", "1"], ["p", "4"], ["random", "1"], ["random", "4"]]
    assert "seed 1" in browser.ask("document.querySelector('#episode-beside h3').textContent")


def test_the_task_is_a_column_of_the_list_only_where_there_are_several(
    browser: Browser, tmp_path: Path
) -> None:
    shown = "getComputedStyle(document.querySelector('#episode-table tbody td')).display"
    browser.open(write_page([full_run()], tmp_path / "several"))
    assert browser.ask(shown) == "table-cell"
    browser.open(write_page([stored(episode("p", 1, True))], tmp_path / "one"))
    assert browser.ask(shown) == "none"


def test_captures_are_linked_from_the_page_to_where_they_are(browser: Browser, tmp_path: Path) -> None:
    run = full_run()
    filmed = run.records[1]
    run = replace(run, path=tmp_path / "a run")
    for file in (video_file(run.path, filmed), rrd_file(run.path, filmed)):
        file.parent.mkdir(parents=True)
        file.write_bytes(b"bytes")
    browser.open(write_page([run], tmp_path / "page"))
    browser.set("task", COLOR)
    browser.set("seed", str(filmed.seed))
    browser.ask("document.querySelector('#episode-table tbody tr').click()")
    links = browser.ask(
        "[...document.querySelectorAll('#episode-beside a')].map(a => [a.textContent, a.href])"
    )
    assert links == [
        ["video", video_file(run.path, filmed).as_uri()],
        ["rrd", rrd_file(run.path, filmed).as_uri()],
    ]
    assert browser.complaints == []


def test_a_poster_is_covered_by_controls_only_where_one_points_at_it(
    browser: Browser, tmp_path: Path
) -> None:
    run = replace(full_run(), path=tmp_path / "run")
    video = video_file(run.path, run.records[0])
    video.parent.mkdir(parents=True)
    video.write_bytes(b"not a video, but bytes")
    browser.open(write_page([run], tmp_path / "page"))
    has_controls = "document.querySelector('.episodes video').controls"
    assert browser.ask(has_controls) is False
    for kind, expected in (("pointerenter", True), ("pointerleave", False), ("focus", True), ("blur", False)):
        browser.ask(f"document.querySelector('.episodes video').dispatchEvent(new Event('{kind}'))")
        assert browser.ask(has_controls) is expected


def test_a_phone_shows_the_page_without_scrolling_sideways(browser: Browser, tmp_path: Path) -> None:
    browser.open(write_page([full_run()], tmp_path / "page"), width=390)
    assert browser.ask("document.documentElement.scrollWidth") <= 390
    assert browser.ask("getComputedStyle(document.querySelector('svg.wide')).display") == "none"


def test_a_section_on_a_probe_fits_a_phone_in_light_and_dark(browser: Browser, tmp_path: Path) -> None:
    sections = probe_sections(PROBE_RUNS)
    page = write_page(PROBE_RUNS, tmp_path / "page", probes=sections)
    colors = []
    for scheme in ("light", "dark"):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        browser.call("Emulation.setEmulatedMedia", {"features": [feature]})
        for width in (390, 1400):
            browser.open(page, width=width)
            assert browser.ask("document.documentElement.scrollWidth") <= width
        colors.append(browser.ask("getComputedStyle(document.querySelector('#probe svg text')).fill"))
    assert len(set(colors)) == 2
    assert browser.ask("document.querySelectorAll('#probe td.right').length") == 1
    assert browser.complaints == []
    assert {url for url in browser.requests if not url.startswith("data:")} == {page.as_uri()}


def test_thirty_thousand_episodes_are_listed_in_one_file(browser: Browser, tmp_path: Path) -> None:
    records = [
        episode(policy, seed, seed % 3 == 0) for policy in ("p", "q", "random") for seed in range(10_000)
    ]
    page = write_page([stored(*records)], tmp_path / "page")
    assert page.stat().st_size < 3_000_000
    browser.open(page)
    assert len(browser.rows("#episode-table tbody tr")) == 100  # only what is shown is drawn
    browser.set("seed", "9999")
    assert [row[1] for row in browser.rows("#episode-table tbody tr")] == ["p", "q", "random"]
    assert browser.complaints == []
