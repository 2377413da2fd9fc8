"""Published results: what they are checked for, and that they are never taken for measured ones."""

import csv
import io
import json
from dataclasses import replace

import pytest

from tests.results.stored_runs import episodes, stored
from vla_eval.cli.main import main
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.page.build import build_page
from vla_eval.results.published.literature import Published, PublishedRate, load_published, paper_figures
from vla_eval.results.published.table import published_side_tables
from vla_eval.results.report import build_table, render

BOARD = "leaderboard_mikasa"


def test_a_mean_is_the_sources_or_computed_from_every_task_or_unknown() -> None:
    published = load_published()
    by_name = {(one.method, one.n_action_steps): one for one in published.of_board(BOARD)}
    octo = by_name["Octo-small", 4]
    assert octo.mean is None
    assert published.mean_of(octo) == pytest.approx((0.46 + 0.39 + 0.45 + 0.17 + 0.11) / 5)
    assert published.mean_of(by_name["SimpleMemVLA", None]) == 0.74
    assert published.mean_of(by_name["ELMUR", None]) is None  # three of five tasks


def test_a_stated_mean_agrees_with_its_rates() -> None:
    published = load_published()
    for one in published.results:
        if one.mean is not None and one.rates:
            computed = published.mean_of(replace(one, mean=None))
            assert computed == pytest.approx(one.mean.rate, abs=0.001), one.method


def test_unknown_values_are_dashes_and_contested_ones_are_marked() -> None:
    rates, how = published_side_tables(BOARD)
    rows = {(row[0], row[1]): row for row in rates.rows}
    assert list(rows["Chameleon", "—"][2:7]) == ["—"] * 5
    assert rows["RATE", "—"][3] == "0.32 ± 0.02 ‡"
    assert any("0.09 ± 0.03 in the appendix" in note for note in rates.notes)
    assert {row[0] for row in how.rows} == {row[0] for row in rates.rows}
    here = [row[0].removesuffix(" [measured here]") for row in rates.rows if "[measured here]" in row[0]]
    assert here == ["memory", "memory in the official code", "cue_blind"]


@pytest.mark.parametrize("fmt", ["markdown", "latex", "html-table"])
def test_they_stand_below_the_measured_table_with_a_title_that_says_so(fmt: str) -> None:
    table = build_table([stored(episodes("p", "++--"))])
    text = render(table, fmt, published=BOARD)  # type: ignore[arg-type]
    measured, published = text.split("Published results, not measured here unless marked")
    assert "MemoryVLA" in published
    assert "MemoryVLA" not in measured


def test_they_are_marked_in_csv_and_json() -> None:
    table = build_table([stored(episodes("p", "++--"))])
    lines = list(csv.DictReader(io.StringIO(render(table, "csv", published=BOARD))))
    assert [line["source"] for line in lines].count("measured") == 1
    unmarked = {line["source"] for line in lines} - {"measured"}
    assert unmarked == {"published", "measured here, not in these runs"}
    assert all(line["success_once"] for line in lines)  # what is unknown has no line
    data = json.loads(render(table, "json", published=BOARD))
    assert len(data["rows"]) == 1
    assert data["published"]["rows"][0]["rates"] == {}


def test_what_is_inferred_is_marked_and_never_a_value() -> None:
    rates, how = published_side_tables(BOARD)
    k = {row[0]: row[1] for row in rates.rows}
    assert k["SimpleMemVLA"] == "perhaps"  # 8 of 16 in its evaluator, not stated for the figure
    tasks = {row[0]: row[how.titles.index("tasks of")] for row in how.rows}
    assert (tasks["SimpleMemVLA"], tasks["Chameleon"], tasks["GMP"]) == ("perhaps", "—", "MIKASA-Robo v0")
    assert any("perhaps K: 8 of 16" in note and "is inferred" in note for note in rates.notes)
    with pytest.raises(RecipeError, match="no value beside perhaps"):
        replace(load_published().results[0], n_action_steps=8, perhaps={"n_action_steps": "8"})
    with pytest.raises(RecipeError, match="a field of a published result"):
        replace(load_published().results[0], perhaps={"horizons": "90"})


def test_published_rows_are_ranked_only_within_one_table_of_one_source() -> None:
    _, how = published_side_tables(BOARD)
    letters: dict[str, set[str]] = {}
    for row in how.rows:
        letters.setdefault(row[1], set()).add(row[0])
    # The paper's VLAs at K = 4; OpenVLA at K = 8 stands apart, beside itself at K = 4.
    assert {"Octo-small", "OpenVLA", "SpatialVLA", "π0"} in letters.values()
    assert {"MemoryVLA", "CronusVLA"} in letters.values()
    assert {"OpenVLA", "GMP", "SimpleMemVLA", "Chameleon", "MemoryVLA++", "ELMUR"} <= letters["apart"]


def test_what_is_from_a_digest_alone_is_marked() -> None:
    rates, _ = published_side_tables("mikasa_vla_90")
    assert {row[0]: row[2] for row in rates.rows}["OpenVLA-OFT with the first frame †"] == "0.850"
    assert any(note.startswith("†: read in digests") for note in rates.notes)


def test_the_best_of_a_task_is_a_result_of_others() -> None:
    published = load_published()
    tasks = published.boards[BOARD].tasks
    best = {task: published.best_of(task, board=BOARD) for task in tasks}
    assert [(one.method, one.rates[task].rate) for task, (one,) in best.items()] == [
        ("GMP", 0.98),
        ("GMP", 0.83),
        ("ELMUR", 0.89),
        ("GMP", 0.61),
        ("ELMUR", 0.23),
    ]
    assert published.best_of("RememberColor4-v0", board=BOARD) == ()


def test_the_papers_table_is_part_of_the_same_file() -> None:
    cells = {(one.model, one.n_action_steps, one.task): one.success_once for one in paper_figures()}
    assert len(cells) == 25  # five rows, five tasks
    assert cells["OpenVLA", 8, "RememberColor3-v0"] == 0.59


def test_a_result_of_an_unknown_task_or_rate_is_refused() -> None:
    published = load_published()
    wrong = replace(published.results[0], rates={"RememberColor4-v0": PublishedRate(rate=0.5)})
    with pytest.raises(RecipeError, match="RememberColor4"):
        Published(
            checked=published.checked,
            sources=published.sources,
            boards=published.boards,
            results=(wrong,),
        )
    with pytest.raises(RecipeError, match="a number from 0 to 1"):
        PublishedRate(rate=41.2)  # percent
    with pytest.raises(UnknownNameError, match="Did you mean 'leaderboard_mikasa'"):
        published_side_tables("leaderbord_mikasa")


def test_report_prints_them_without_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--published"]) == 0
    assert "MemoryVLA++" in capsys.readouterr().out
    assert main(["report"]) == 1
    assert "Name at least one RUN" in capsys.readouterr().err


def test_the_page_has_them_below_its_results() -> None:
    runs = [stored(episodes("p", "++--"))]
    assert "MemoryVLA++" in build_page(runs, published=BOARD)
    assert "MemoryVLA++" not in build_page(runs)
