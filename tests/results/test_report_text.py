"""The success table as text, and the command that prints it."""

import argparse
import csv
import io
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.results.stored_runs import episode, episodes, stored
from vla_eval.cli import report as report_verb
from vla_eval.errors import ReportError, UnknownNameError
from vla_eval.results.report import FORMATS, Format, Table, build_table, render
from vla_eval.results.verdict import verdicts
from vla_eval.storage.run_folder import RunFolder

# ------------------------------------------------------------------------------- formats


def a_table() -> Table:
    groups = (episodes("my_policy", "++-e"), episodes("random", "----"), episodes("tour", "e"))
    return build_table([stored(*groups)])


def test_markdown_columns_are_aligned() -> None:
    lines = [line for line in render(a_table(), "markdown").splitlines() if line.startswith("|")]
    assert len({len(line) for line in lines}) == 1
    positions = [[i for i, char in enumerate(line) if char == "|"] for line in lines]
    assert all(found == positions[0] for found in positions)


def demo_like(n_tasks: int) -> Table:
    """The rows of `make demo`: oracle, cue_blind and random, on some of its tasks."""
    tasks = ("RememberColor3-v0", "InterceptMedium-v0", "ShellGameTouch-v0")[:n_tasks]
    outcomes = {"oracle": "+" * 20, "cue_blind": "+" * 7 + "-" * 13, "random": "-" * 20}
    return build_table(
        [stored(*(episodes(name, text, task=task) for task in tasks for name, text in outcomes.items()))]
    )


@pytest.mark.parametrize("n_tasks", [1, 2, 3])
def test_the_table_fits_a_terminal_of_100_columns_with_success_third_at_most(n_tasks: int) -> None:
    lines = [line for line in render(demo_like(n_tasks), "markdown").splitlines() if line.startswith("|")]
    assert max(map(len, lines)) <= 100
    titles = [title.strip() for title in lines[0].strip("|").split("|")]
    assert titles.index("success once") <= 2
    assert "vs cue_blind" in titles and "vs random" in titles


def test_a_narrower_terminal_gets_fewer_columns() -> None:
    text = render(demo_like(3), "markdown", width=80)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert max(map(len, lines)) <= 80
    assert "success once" in lines[0] and "vs random" not in lines[0]
    assert "not shown: vs random" in text


def test_what_is_the_same_in_all_rows_is_said_above_and_what_has_no_room_below() -> None:
    text = render(demo_like(2), "markdown")
    assert text.splitlines()[0] == "All rows: K 1, chance 0.35, ceiling 1.00, episodes 20, errors 0."
    # Nothing but success in any of these records is an inference or a step: what was left out has values.
    (left_out,) = re.findall(r"^- not shown: (.*) \(`--wide` shows every column\)\.$", text, re.M)
    wide = render(demo_like(2), "markdown", wide=True)
    titles = [title.strip() for title in wide.splitlines()[0].strip("|").split("|")]
    assert set(left_out.split(", ")) < set(titles) and {"K", "episodes", "errors"} < set(titles)
    assert "not shown" not in wide and "All rows" not in wide


def test_a_column_that_differs_is_never_folded_or_left_out() -> None:
    groups = episodes("a" * 60, "+" * 9 + "e"), episodes("cue_blind", "-" * 12), episodes("random", "-" * 12)
    head = render(build_table([stored(*groups)]), "markdown").splitlines()
    assert head[0] == "All rows: task RememberColor3-v0, K 1, chance 0.00."
    assert {"episodes", "errors"} < {title.strip() for title in head[2].strip("|").split("|")}


def test_wide_is_refused_where_every_column_is_there_anyway() -> None:
    with pytest.raises(ReportError, match="--wide: json has every column"):
        render(a_table(), "json", wide=True)
    with pytest.raises(ReportError, match="--preset paper is a whole table in LaTeX"):
        render(a_table(), "markdown", preset="paper")


@pytest.mark.parametrize("fmt", ["markdown", "latex"])
def test_only_the_columns_that_were_asked_for_are_shown_in_their_order(fmt: Format) -> None:
    head = next(line for line in render(a_table(), fmt, columns=["K", "policy"]).splitlines() if "K" in line)
    assert re.findall(r"\w+", head) == ["K", "policy"]


def test_columns_that_are_mistyped_or_of_no_use_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'success'"):
        render(a_table(), "markdown", columns=["policy", "succes"])
    with pytest.raises(ReportError, match="csv has every column"):
        render(a_table(), "csv", columns=["policy"])


def test_the_help_names_every_column(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnknownNameError) as error:
        render(a_table(), "markdown", columns=["?"])
    known = re.search(r"Known: (.*)\.", str(error.value))
    assert known is not None
    parser = argparse.ArgumentParser()
    report_verb.add_arguments(parser.add_subparsers().add_parser("report"))
    with pytest.raises(SystemExit):
        parser.parse_args(["report", "--help"])
    told = capsys.readouterr().out.partition("for reading:")[2].partition("--html")[0]
    assert sorted(told.split()) == sorted(known[1].split(", "))


def test_json_holds_every_column_and_null_where_undefined() -> None:
    data = json.loads(render(a_table(), "json"))
    required = """task policy n_action_steps n_episodes n_success_once success_once ci_low ci_high interval
        n_runs sem success_at_end first_choice_success n_errors mean_success_step inferences_per_episode
        baseline paired_difference n_pairs paired_p paired_p_raw chance chance_source ceiling
        chance_corrected variant"""
    assert set(required.split()) <= set(data["rows"][0])
    assert data["rows"][0]["ceiling"] is None and data["rows"][2]["success_once"] is None
    assert data["notes"] == list(a_table().notes)


def test_csv_holds_the_columns_of_the_json_and_nothing_else() -> None:
    rows = list(csv.DictReader(io.StringIO(render(a_table(), "csv"))))
    data = json.loads(render(a_table(), "json"))["rows"]
    assert list(rows[0]) == list(data[0])
    assert [row["policy"] for row in rows] == ["my_policy", "random", "tour"]
    assert float(rows[0]["success_once"]) == data[0]["success_once"]
    assert rows[2]["success_once"] == ""


def test_latex_is_booktabs_with_everything_escaped() -> None:
    text = render(a_table(), "latex")
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"my\_policy", "---", r"\texttt{cue\_blind}"):
        assert part in text
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len({line.count(" & ") for line in body}) == 1
    assert not set("—±×†π“”") & set(text)


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_difference_that_rounds_to_nothing_is_not_minus_zero(fmt: str) -> None:
    groups = episodes("p", "+" + "-" * 300), episodes("random", "++" + "-" * 299)
    assert "-0.00 " not in render(build_table([stored(*groups)]), fmt)  # type: ignore[arg-type]


def test_the_papers_figures_stand_apart_and_are_marked() -> None:
    text = render(a_table(), "markdown", paper=True)
    ours, theirs = text.split("The paper's figures, not measured here (mean ± SEM, 3 runs × 100 episodes)")
    assert "OpenVLA" not in ours
    # The paper's table, row OpenVLA (K = 8), column RememberColor3.
    assert "| RememberColor3-v0 | OpenVLA       |  8 |          0.59 ± 0.04 |" in theirs
    assert "ShellGameTouch" not in theirs


def test_the_papers_figures_are_marked_in_the_other_formats_too() -> None:
    data = json.loads(render(a_table(), "json", paper=True))
    assert len(data["rows"]) == 3 and len(data["paper"]["rows"]) == 5
    rows = list(csv.DictReader(io.StringIO(render(a_table(), "csv", paper=True))))
    assert [row["source"] for row in rows] == ["measured"] * 3 + ["paper"] * 5
    assert "The paper's figures, not measured here" in render(a_table(), "latex", paper=True)


def test_tasks_that_the_paper_did_not_measure_get_no_figures() -> None:
    table = build_table([stored(episodes("p", "+", task="Mine-v0"))])
    assert "has none of these tasks" in render(table, "markdown", paper=True)


# ------------------------------------------------------------------------------- command line


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    report_verb.add_arguments(parser.add_subparsers(dest="verb").add_parser("report"))
    return parser.parse_args(["report", *words])


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    description = stored([]).description
    with RunFolder.open(tmp_path / "demo", description) as folder:
        for record in (*episodes("p", "+-", first_choice=0), *episodes("random", "--")):
            folder.append(record)
    return tmp_path / "demo"


def test_report_prints_the_table_and_nothing_else(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report_verb.run(arguments(str(run_folder), "--format", "json")) == 0
    captured = capsys.readouterr()
    assert [row["policy"] for row in json.loads(captured.out)["rows"]] == ["p", "random"]
    assert captured.err == ""


def test_the_notes_of_a_csv_go_to_standard_error(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report_verb.run(arguments(str(run_folder), "--format", "csv"))
    captured = capsys.readouterr()
    assert captured.out.count("\n") == 3
    assert "note: vs random" in captured.err


def test_the_baseline_random_is_an_error_only_if_it_was_asked_for(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "demo", stored([]).description) as folder:
        folder.append(episode("p", 1, "+", first_choice=0))
    assert report_verb.run(arguments(str(tmp_path / "demo"))) == 0
    with pytest.raises(UnknownNameError, match="there is no policy 'random'"):
        report_verb.run(arguments(str(tmp_path / "demo"), "--baseline", "random"))


def test_help_does_not_wait_for_scipy_and_a_report_needs_no_torch(run_folder: Path) -> None:
    code = (
        "import sys, argparse, vla_eval.cli.report as verb\n"
        "print('scipy' in sys.modules)\n"
        "parser = argparse.ArgumentParser()\n"
        "verb.add_arguments(parser.add_subparsers().add_parser('report'))\n"
        f"verb.run(parser.parse_args(['report', {str(run_folder)!r}]))\n"
        "heavy = ('torch', 'sapien', 'mani_skill', 'lerobot', 'cv2', 'rerun', 'pandas')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, *_, last = output.stdout.splitlines()
    assert (first, last) == ("False", "[]")


def test_without_a_measured_chance_the_verdict_begins_with_the_best_and_keeps_the_tables_order() -> None:
    records = [*episodes("bad", "+---"), *episodes("good", "++++", n_action_steps=1)]
    records += episodes("good", "++++", n_action_steps=8)

    (verdict,) = verdicts(build_table([stored(records)]))

    *said, last = verdict.sentences
    # `bad` was run at K = 1: with the row at K = 8 it is not ranked.
    assert [text.partition(" succeeds")[0] for text in said] == ["good, K=1", "bad", "good, K=8"]
    assert not verdict.is_compared
    # Of the task, so once: 1/3 for three candidates.
    assert last == (
        "Chance is 0.33 by arithmetic: without cue_blind on the same episodes, nothing is said of memory."
    )


def test_a_verdict_says_at_which_n_action_steps_chance_was_not_measured() -> None:
    records = [*episodes("p", "+" * 8, n_action_steps=1), *episodes("cue_blind", "-" * 8, n_action_steps=1)]
    records += [episode("p", seed, "+", n_action_steps=8) for seed in range(101, 109)]  # other episodes

    (verdict,) = verdicts(build_table([stored(records)]))

    assert verdict.is_compared
    assert verdict.sentences[0].startswith("p, K=1 beats chance by +1.00")
    assert verdict.sentences[1].startswith("p, K=8 succeeds in 1.00")
    assert verdict.sentences[2].startswith("Chance at K = 8 is ")


def test_a_verdict_is_said_once_for_all_n_action_steps_at_which_it_is_the_same() -> None:
    won = {1: 30, 4: 28, 8: 12}  # of 30; chance wins the first 10
    records = [
        record
        for k, n in won.items()
        for record in (
            *episodes("p", "+" * n + "-" * (30 - n), n_action_steps=k),
            *episodes("cue_blind", "+" * 10 + "-" * 20, n_action_steps=k),
        )
    ]

    (verdict,) = verdicts(build_table([stored(records)]))

    beats, not_shown = verdict.sentences
    # 28/30 less 10/30, and 12/30 less 10/30.
    assert beats.startswith("p beats chance at K = 1 and 4; the smallest difference, at K = 4, is +0.60 [")
    assert "p < 0.001" in beats
    assert not_shown.startswith("p, K=8 is not shown to beat chance: +0.07 [")
