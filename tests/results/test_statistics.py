"""One row per statistic: a new one is that row alone; a table compares with as many policies as it has."""

import argparse
import csv
import io
import json

import pytest

from tests.results.stored_runs import episodes, has_note, stored
from vla_eval.cli import report as report_verb
from vla_eval.page.build import build_page
from vla_eval.results import report, statistics
from vla_eval.results.own_statistics import SUCCESS
from vla_eval.results.printed_table import Column
from vla_eval.results.report import Table, build_table, render
from vla_eval.results.success_table import Statistic

TOY: Statistic[int] = Statistic(
    estimate=lambda of: 7 * len(of.episodes.results),
    cells=lambda value: {"toy_cell": value, "toy_known": "yes"},
    columns=(Column("toy title", lambda row: f"<{row[TOY]}>", name="toy", rank=1),),
    notes=lambda rows: [f"toy: {sum(row[TOY] for row in rows)} in all."],
)


@pytest.fixture
def with_toy(monkeypatch: pytest.MonkeyPatch) -> Table:
    monkeypatch.setattr(statistics, "STATISTICS", (*statistics.STATISTICS, TOY))
    return build_table([stored(episodes("p", "++-"), episodes("random", "----"))])


def test_a_statistic_is_added_by_its_row_alone(with_toy: Table) -> None:
    """Two rows, of 3 and of 4 episodes: 21 and 28."""
    for fmt, shown in (("markdown", "<21>"), ("latex", "$<$21$>$"), ("html-table", "&lt;21&gt;")):
        text = render(with_toy, fmt)  # type: ignore[arg-type]
        assert "toy title" in text and shown in text and "toy: 49 in all." in text
    lines = list(csv.DictReader(io.StringIO(render(with_toy, "csv"))))
    assert [(line["toy_cell"], line["toy_known"]) for line in lines] == [("21", "yes"), ("28", "yes")]
    assert [row["toy_cell"] for row in json.loads(render(with_toy, "json"))["rows"]] == [21, 28]
    assert "toy_cell" in statistics.column_names()  # of a table without rows, too
    assert "<28>" in render(with_toy, "markdown", columns=["policy", "toy"])


def test_a_statistic_that_is_added_is_on_the_page(with_toy: Table) -> None:
    page = build_page([stored(episodes("p", "++-"), episodes("random", "----"))])
    assert "toy title" in page and "&lt;21&gt;" in page and "toy: 49 in all." in page


def test_a_statistic_that_is_added_is_named_by_the_help(
    with_toy: Table, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    report_verb.add_arguments(parser.add_subparsers().add_parser("report"))
    with pytest.raises(SystemExit):
        parser.parse_args(["report", "--help"])
    assert "toy" in capsys.readouterr().out.split()


def test_no_two_statistics_have_a_cell_or_a_column_of_the_same_name() -> None:
    names = [*statistics.column_names()]
    assert len(names) == len(set(names))
    columns = [column.name for one in statistics.STATISTICS for column in one.columns]
    assert len(columns) == len(set(columns)) and "" not in columns


def test_a_table_compares_with_three_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    # p wins all six pairs against random and hold, four against cue_blind.
    monkeypatch.setattr(report, "DEFAULT_BASELINES", ("cue_blind", "random", "hold"))
    outcomes = {"p": "++++++", "cue_blind": "++----", "random": "------", "hold": "------"}
    table = build_table([stored(*(episodes(name, text) for name, text in outcomes.items()))])

    # Three of p, two of cue_blind, one of random: no pair of policies is tested twice.
    assert table.n_comparisons == 6
    assert has_note(table, "vs cue_blind, vs random, vs hold: difference", "over 6 comparisons")
    p = table.rows[0].to_dict()
    assert (p["baseline"], p["second_baseline"], p["third_baseline"]) == ("cue_blind", "random", "hold")
    assert (p["paired_difference"], p["third_difference"], p["third_n_pairs"]) == (4 / 6, 1, 6)
    for fmt in ("markdown", "latex", "html-table"):
        text = render(table, fmt, wide=True)  # type: ignore[arg-type]
        assert all(f"vs {name}" in text.replace("\\_", "_") for name in ("cue_blind", "random", "hold"))
    (line, *_) = csv.DictReader(io.StringIO(render(table, "csv")))
    assert line["third_baseline"] == "hold" and float(line["third_p_raw"]) == 2 / 2**6
    assert "+1.00 (p=" in render(table, "markdown", columns=["policy", "third_difference"])
    assert json.loads(render(table, "json"))["baselines"] == ["cue_blind", "random", "hold"]


def test_a_row_gives_the_value_of_each_statistic() -> None:
    (row,) = build_table([stored(episodes("p", "++--"))]).rows
    assert (row[SUCCESS].success_once, row[SUCCESS].n_runs) == (0.5, 1)
    assert set(row.estimates) == set(statistics.STATISTICS)
