"""The report page: equal to the JSON report, nothing made up, nothing that could become markup or load."""

import base64
import hashlib
import json
import os
import re
from dataclasses import replace
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import pytest

from vla_eval.cli.main import main
from vla_eval.errors import ReportError
from vla_eval.page.build import build_page, with_code, write_page
from vla_eval.page.charts import MARKERS, Bar, Chart, Curves, Point, Series, curves, forest, sign
from vla_eval.page.rates import _round_ticks
from vla_eval.page.svg import PALETTE
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.results.report import build_table, render
from vla_eval.results.table_columns import lay_out
from vla_eval.storage.capture_files import video_file
from vla_eval.storage.run_folder import RunDescription, RunFolder, Session, StoredRun, read_run

COLOR, INTERCEPT = "RememberColor3-v0", "InterceptMedium-v0"


def episode(policy: str, seed: int, won: bool, *, task: str = COLOR, k: int = 1) -> EpisodeRecord:
    target = seed % 3
    choice = {"target": target, "n_candidates": 3, "first_choice": target if won else (target + 1) % 3}
    return EpisodeRecord(
        task=task,
        policy=policy,
        n_action_steps=k,
        run=0,
        seed=seed,
        outcome="success" if won else "failure",
        success_once=won,
        success_at_end=won,
        success_step=20 + seed if won else None,
        n_steps=60,
        first_choice_success=won if task == COLOR else None,
        n_inferences=60 // k,
        trajectory_sha256=f"{task}{policy}{k}{seed}",
        **(choice if task == COLOR else {}),
    )


def error(policy: str, seed: int, message: str = "gone") -> EpisodeRecord:
    failed = EpisodeError(kind="WorkerCrashed", stage="step", message=message)
    return EpisodeRecord(
        task=COLOR, policy=policy, n_action_steps=1, run=0, seed=seed, outcome="error", error=failed
    )


def stored(*records: EpisodeRecord, path: Path = Path("runs/a"), name: str = "demo") -> StoredRun:
    description = RunDescription(
        name=name,
        config={"tasks": [COLOR], "episodes": 4},
        recipes={"policies/p": "f00d"},
        environment={
            "python": "3.12.1",
            "packages": {"numpy": "2.2.6", "lerobot": None},
            "vla_eval": {"version": "0.1.0", "commit": "c0ffee", "changes": "d1ff"},
        },
        options={},
        command="mikasa-vla eval demo",
    )
    session = Session(started_at="2030-01-01T00:00:00+00:00", command="mikasa-vla eval demo", options={})
    return StoredRun(path=path, description=description, records=records, sessions=(session,))


def full_run() -> StoredRun:
    return stored(
        *(episode(policy, seed, seed < n, k=k) for policy, n in (("p", 4), ("random", 1)) for k in (1, 4)
          for seed in range(6)),
        *(episode("p", seed, seed % 2 == 0, task=INTERCEPT) for seed in range(4)),
        error("p", 6),
    )  # fmt: skip


@lru_cache
def full_page() -> str:
    """Build it once: the statistics take a while."""
    return build_page([full_run()])


class Page(HTMLParser):
    """Reads back the rows of the first table, the sections, and what the page would load."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.data: list[dict[str, object]] = []
        self.sections: dict[str, str] = {}
        self.loads: list[str] = []
        self._section = self._cell = None
        self._tables = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self._tables += tag == "table"
        if tag == "section":
            self._section = named["id"]
            self.sections[self._section] = ""
        if tag == "tr" and self._tables == 1:
            self.rows.append([])
            if named.get("data-row"):
                self.data.append(json.loads(named["data-row"] or ""))
        if tag in ("td", "th"):
            self._cell = tag
            if self._tables == 1:
                self.rows[-1].append("")
        self.loads += [value for name, value in attrs if name in ("src", "href", "poster") and value]

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th"):
            self._cell = None

    def handle_data(self, data: str) -> None:
        if self._section:
            self.sections[self._section] += data
        if self._cell and self._tables == 1:
            self.rows[-1][-1] += data


def test_the_table_of_the_page_is_the_json_report() -> None:
    run = full_run()
    page, table = Page(full_page()), build_table([run])
    assert page.data == json.loads(render(table, "json"))["rows"]
    layout = lay_out(table)
    assert page.rows == [layout.titles, *map(list, layout.rows)]


def test_the_json_report_is_in_the_page_for_programs() -> None:
    run = full_run()
    text = re.search(r'<script type="application/json" id="report">(.*?)</script>', full_page(), re.S)
    assert text is not None
    assert json.loads(text[1]) == json.loads(render(build_table([run]), "json"))


def test_the_same_runs_give_the_same_page() -> None:
    assert full_page() == build_page([full_run()])


def test_a_run_is_reproduced_from_its_commit_by_its_commands_with_its_versions_and_digests() -> None:
    section = re.search(r'<section id="reproduce">(.*?)</section>', full_page(), re.S)
    assert section is not None
    commands, lock = re.findall(r"<pre>(.*?)</pre>", section[1], re.S)[:2]
    assert commands.splitlines()[0] == "git checkout c0ffee"
    assert commands.splitlines()[-1] == "mikasa-vla eval demo"
    assert lock.splitlines() == ["# Python 3.12.1", "numpy==2.2.6", "# sha256", "f00d  policies/p"]
    assert "uncommitted changes" in section[1]


def test_every_section_is_there_and_speaks() -> None:
    sections = Page(full_page()).sections
    # No latency: the folder of these runs, and with it the times, does not exist.
    assert list(sections) == [
        *("verdict", "success", "table", "chunks", "paired", "choices", "steps", "errors", "episodes"),
        *("passport", "reproduce"),
    ]
    assert "WorkerCrashed" in sections["errors"]
    assert "mikasa-vla eval demo" in sections["reproduce"] and "f00d" in sections["reproduce"]
    assert "3.12.1" in sections["reproduce"]


def test_targets_and_choices_are_called_by_the_colors_of_the_cubes() -> None:
    choices = Page(full_page()).sections["choices"]
    # Seeds 0 to 5 have targets 0, 1, 2, 0, 1, 2; seeds 4 and 5 end with the next color.
    rows = ("red2000", "green0110", "blue1010")
    matrix = "".join(choices.split("target ↓ ")[1].split())
    assert matrix.startswith("chosen→redgreenbluenone" + "".join(rows))


def test_no_section_says_that_there_is_nothing() -> None:
    page = build_page([stored(episode("p", 1, True, task=INTERCEPT))])
    there = ["verdict", "success", "table", "steps", "episodes", "passport", "reproduce"]
    assert list(Page(page).sections) == there
    assert re.findall(r'<li><a href="#(\w+)">', page) == ["verdict", "table", "success", *there[3:]]


def test_the_page_begins_with_what_is_shown_about_memory() -> None:
    # Ten of ten against four of ten on the same seeds: six pairs differ, 2/2⁶ = 0.031; two comparisons.
    groups = {"p": 10, "twin": 4, "cue_blind": 4}
    run = stored(*(episode(name, seed, seed < n) for name, n in groups.items() for seed in range(10)))
    words = Page(build_page([run])).sections["verdict"]
    assert "p is not shown to beat chance: +0.60" in words and "p = 0.062" in words
    assert words.index("p is not") < words.index("twin is not shown to beat chance: +0.00")


def test_every_episode_is_in_the_page_once_as_numbers() -> None:
    text = re.search(r'<script type="application/json" id="episode-data">(.*?)</script>', full_page(), re.S)
    assert text is not None
    data = json.loads(text[1])
    read = [dict(zip(data["fields"], one, strict=True)) for one in data["episodes"]]
    told = {
        (data["rows"][one["row"]]["task"], data["rows"][one["row"]]["policy"], data["rows"][one["row"]]["k"],
         one["seed"]): (data["outcomes"][one["outcome"]], one["step"], one["target"], one["chosen"])
        for one in read
    }  # fmt: skip
    assert len(read) == len(told)
    assert told == {
        (r.task, r.policy, r.n_action_steps, r.seed): (r.outcome, r.success_step, r.target, r.first_choice)
        for r in full_run().records
    }
    assert data["errors"] == ["WorkerCrashed: gone"]


def test_only_the_page_s_own_script_may_run() -> None:
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', full_page())
    (script,) = re.findall(r"<script>(.*?)</script>", full_page(), re.S)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy and "default-src 'none'" in policy
    assert "unsafe" not in policy.replace("style-src 'unsafe-inline'", "")


@pytest.mark.parametrize(
    ("end", "ticks"),
    [(60, [0, 10, 20, 30, 40, 50, 60]), (90, [0, 20, 40, 60, 80, 100]), (6, [0, 1, 2, 3, 4, 5, 6])],
)
def test_ticks_of_steps_are_round_and_reach_the_horizon(end: int, ticks: list[int]) -> None:
    assert _round_ticks(end) == ticks


def test_curves_go_on_until_the_horizon() -> None:
    """With `stop_at_success` a policy that always succeeds has no step at the horizon."""
    quick = [replace(episode("p", seed, True), n_steps=20 + seed) for seed in range(3)]
    run = stored(*quick, *(episode("q", seed, False) for seed in range(3)))
    charts = re.search(r'<section id="steps">(.*?)</section>', build_page([run]), re.S)
    assert charts is not None
    ends = [float(path.split()[-2]) for path in re.findall(r'class="curve"><path d="([^"]*)"', charts[1])]
    assert len(ends) == 2 and ends[0] == pytest.approx(ends[1], abs=0.01)


def test_points_of_two_policies_at_one_k_are_beside_each_other() -> None:
    series = [
        Series(name=name, color=i, points=(Point(1, 0.5), Point(8, 0.5))) for i, name in enumerate("pq")
    ]
    drawn = drawn_curves(*series, x_ticks=[1, 8])
    first, _, second, _ = (
        float(x) for x in re.findall(r'class="marker"><path [^>]*translate\(([\d.]+) ', drawn)
    )
    assert 3 < abs(first - second) < 10  # px


@pytest.mark.parametrize(
    "evil",
    [
        "</script><script>alert(1)</script><img src=http://evil>",
        "</text></svg><script>alert(1)</script>",
        '"><script>alert(1)</script><a title="',
        "{{ 7 * 7 }}{% include 'page.css' %}",  # a template's marks
        r"$\frac{$ & ünï 記憶",  # no formula; no glyph of matplotlib's font
        "\x1b[31m red \x00",  # no XML can hold these
    ],
)
def test_text_of_a_run_never_becomes_markup(evil: str) -> None:
    page = build_page(
        [stored(episode(evil, 1, True), episode(evil, 1, True, k=4), error("p", 2, evil), name=evil)]
    )
    read = Page(page)
    assert "<script>alert" not in page
    assert [link for link in read.loads if "evil" in link] == []
    assert read.rows[1][0] == evil  # the name of the policy is shown as it is
    assert evil in read.sections["errors"] and evil in read.sections["reproduce"]
    assert "49" not in read.sections["table"]


def test_a_name_is_drawn_as_it_is() -> None:
    drawn = one_bar(r'$a$ <b> & "c"').svg
    assert r'>$a$ &lt;b&gt; &amp; "c"</text>' in drawn


def test_nothing_is_loaded_from_anywhere(tmp_path: Path) -> None:
    run = stored(*full_run().records, path=tmp_path)
    video = video_file(tmp_path, run.records[0])
    video.parent.mkdir()
    video.write_bytes(b"not a video, but bytes")
    page = build_page([run])
    assert "default-src 'none'" in page
    links = [link for link in Page(page).loads if not link.startswith("#")]
    assert {link.split(",")[0] for link in links} == {"data:", "data:video/mp4;base64"}


def drawn_curves(*series: Series, x_ticks: list[float]) -> str:
    return curves(Curves(series=series, title="t", description="d", x_title="K", x_ticks=x_ticks)).svg


def one_bar(label: str = "a") -> Chart:
    bar = Bar(label=label, color=0, value=0.5, low=0.25, high=0.75, chance=0.3, ceiling=1.0)
    return forest([bar], title="t", description="d")


def test_a_rate_lies_where_it_belongs_and_no_result_is_said_in_words() -> None:
    bars = [
        Bar(label="a", color=0, value=0.5, low=0.25, high=0.75, chance=None, ceiling=None),
        Bar(label="b", color=1, value=None, low=None, high=None, chance=None, ceiling=None),
    ]
    drawn = forest(bars, title="t", description="d").svg
    whisker = re.search(r'<g class="whisker"><path d="M ([\d.]+) [\d.]+ L ([\d.]+) ', drawn)
    marker = re.search(r'<g class="marker"><path [^>]*translate\(([\d.]+) ', drawn)
    assert whisker and marker
    assert float(marker[1]) - float(whisker[1]) == pytest.approx(190, abs=0.02)  # a quarter of 760 px
    assert float(whisker[2]) - float(marker[1]) == pytest.approx(190, abs=0.02)
    assert "no result" in drawn


def test_a_higher_rate_is_drawn_higher() -> None:
    points = (Point(1, 0.0), Point(8, 1.0))
    drawn = drawn_curves(Series(name="p", color=0, points=points), x_ticks=[1, 8])
    corners = re.search(r'<g class="curve"><path d="M ([\d.]+) ([\d.]+) L ([\d.]+) ([\d.]+)"', drawn)
    assert corners is not None
    x1, y1, x2, y2 = map(float, corners.groups())
    assert x1 < x2 and y1 - y2 == pytest.approx(180)  # the height of the plot


def test_a_rate_holds_until_the_step_of_the_next_success() -> None:
    points = (Point(0, 0.0), Point(50, 1.0), Point(100, 1.0))
    one = Series(name="p", color=0, points=points, is_step=True)
    drawn = drawn_curves(one, x_ticks=[0, 100])
    path = re.search(r'<g class="curve"><path d="M ([^"]*)"', drawn)
    assert path is not None
    corners = [tuple(map(float, corner.split())) for corner in path[1].split(" L ")]
    (x0, low), (x50, high), (x100, _) = corners[0], corners[2], corners[-1]
    assert x50 - x0 == pytest.approx(x100 - x50, abs=0.02)
    assert (x50, low) in corners and (x50, high) in corners and low > high  # straight up, not slanting


def test_colors_are_those_of_the_page_so_that_dark_mode_and_print_have_theirs() -> None:
    drawn = one_bar().svg + "".join(sign(n, is_line=line) for n in range(9) for line in (True, False))
    used = set(re.findall(r"(?:fill|stroke): ([^;\"]+)", drawn))
    assert used <= {f"var(--{name})" for name in PALETTE} | {"none"}
    assert {"var(--c0)", "var(--c5)", "var(--ink)", "var(--muted)"} <= used
    style = re.search(r"<style>(.*?)</style>", full_page(), re.S)
    assert style is not None
    light = dict(re.findall(r"--(\w+): (#\w+)", style[1].partition("@media")[0]))
    light["paper"] = light["paper"].replace("#fff", "#ffffff")
    assert light.items() >= PALETTE.items()


def test_charts_of_one_page_share_no_ids_and_no_styles() -> None:
    drawn = one_bar().svg
    assert not re.search(r"\bid=|href=|url\(|<style|<defs", drawn)
    assert full_page().count("<style") == 1


def test_seven_policies_have_seven_markers_and_seven_dashes() -> None:
    markers = {str(re.findall(r' d="([^"]*)"', sign(n, is_line=False))) for n in range(len(MARKERS))}
    dashes = {str(re.findall(r"dasharray: ([^;]*)", sign(n, is_line=True))) for n in range(len(MARKERS))}
    assert len(markers) == len(dashes) == 7


def test_settings_of_the_user_for_matplotlib_move_nothing() -> None:
    with matplotlib.rc_context(
        {"font.size": 30, "svg.fonttype": "path", "axes.grid": False, "lines.linewidth": 9}
    ):
        drawn = one_bar()
    assert drawn == one_bar()


def test_names_between_backticks_are_set_as_code_and_still_escaped() -> None:
    assert with_code("chance: `cue_blind` < `a<b`") == (
        "chance: <code>cue_blind</code> &lt; <code>a&lt;b</code>"
    )
    assert with_code("a ` alone") == "a ` alone"


def test_the_verb_prints_the_path_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    description = replace(stored().description, config={"tasks": [COLOR, INTERCEPT], "episodes": 4})
    with RunFolder.open(tmp_path / "run", description) as folder:
        for record in full_run().records:
            folder.append(record)
    assert main(["report", str(tmp_path / "run"), "--html", str(tmp_path / "page")]) == 0
    page = tmp_path / "page" / "index.html"
    assert capsys.readouterr().out == f"{page}\n"
    assert page.read_text(encoding="utf-8") == build_page([read_run(tmp_path / "run")])


def test_a_page_has_no_other_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunFolder.open(tmp_path / "run", stored().description) as folder:
        folder.append(episode("p", 1, True))
    assert main(["report", str(tmp_path / "run"), "--html", str(tmp_path), "--format", "csv"]) == 1
    assert "--html writes a page" in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ReportError, match=r"file/page/index\.html: cannot be written"):
        write_page([full_run()], tmp_path / "file" / "page")


def test_a_folder_whose_name_is_no_utf_8_is_shown_escaped(tmp_path: Path) -> None:
    run = replace(full_run(), path=Path(os.fsdecode(b"runs/\xfc")))
    page = write_page([run], tmp_path / "page").read_text(encoding="utf-8")
    assert "runs/\\udcfc" in page
