"""The table as a paper has it: what it says, and that LaTeX sets it within one line width."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.results.stored_runs import COLOR, INTERCEPT, episodes, stored
from vla_eval.policies.registry import POLICIES
from vla_eval.results.latex_preset import CONTROLS
from vla_eval.results.report import build_table, render
from vla_eval.results.success_table import Table
from vla_eval.results.sweep import compare_runs
from vla_eval.results.sweep_format import render_sweep

PDFLATEX = shutil.which("pdflatex")
TASKS = (COLOR, INTERCEPT, "RememberShapeAndColor5x3-v0", "ShellGameTouch-v0", "SeqOfColors7-v0", "Rotate-v0")
OUTCOMES = {
    "memory_color3": "+" * 20,
    "memoryless_color3": "+" * 6 + "-" * 14,
    "oracle": "+" * 20,
    "cue_blind": "+" * 4 + "-" * 16,
    "random": "-" * 20,
}


def a_table(*tasks: str, policies: tuple[str, ...] = tuple(OUTCOMES), runs: int = 1) -> Table:
    groups = [
        episodes(name, OUTCOMES[name], task=task, run=run)
        for task in tasks
        for name in policies
        for run in range(runs)
    ]
    return build_table([stored(*groups)])


def preset(table: Table) -> str:
    return render(table, "latex", preset="paper")


def rows_of(text: str) -> list[list[str]]:
    lines = [re.sub(r" \\\\(\[2pt\])?$", "", line) for line in text.splitlines() if r" \\" in line]
    return [[cell.strip() for cell in line.split("&")] for line in lines]


def test_tasks_are_columns_policies_are_rows_and_the_best_policy_is_bold() -> None:
    first, second, *rows = rows_of(preset(a_table(COLOR, INTERCEPT)))
    assert (first, second) == (["", "Remember", "Intercept"], ["", "Color3", "Medium"])
    by_name = {row[0]: row[1:] for row in rows if row[0]}
    assert by_name[r"memory\_color3"] == [r"\textbf{1.00}"] * 2
    assert by_name[r"memoryless\_color3"] == ["0.30"] * 2
    assert by_name["oracle"] == ["1.00"] * 2  # a control is never the best policy
    # Wilson, 6 of 20: (0.3 + 0.09604) / 1.19207 ± 0.18675.
    assert [r"{\scriptsize [0.15, 0.52]}"] * 2 in [row[1:] for row in rows]


@pytest.mark.parametrize(
    ("outcomes", "why"),
    [
        (("-" * 20, "-" * 20), "a tie at the floor"),
        (("+" * 20, "+" * 20), "a tie at the ceiling"),
        (("+" * 4 + "-" * 16, "-" * 20), "at chance"),
        (("+" * 3 + "-" * 17, "-" * 20), "below chance"),
        (("+" * 20, "+" * 17 + "---"), "3 episodes are no difference: p = 0.25"),
        (("+" * 20,), "nothing to be better than"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_nothing_is_bold_that_is_not_shown_to_be_the_best(outcomes: tuple[str, ...], why: str) -> None:
    names = ("first", "second")[: len(outcomes)]
    groups = [episodes(name, found) for name, found in zip(names, outcomes, strict=True)]
    table = build_table([stored(*groups, episodes("cue_blind", OUTCOMES["cue_blind"]))])
    assert "textbf" not in preset(table), why


def test_without_a_measured_chance_the_interval_has_to_be_above_it() -> None:
    def shown(best: str) -> str:
        return preset(build_table([stored(episodes("a", best), episodes("b", "-" * 20))]))

    assert r"\textbf{0.75}" in shown("+" * 15 + "-" * 5)  # Wilson's lower end 0.53 is above 1/3
    assert "textbf" not in shown("+" * 9 + "-" * 11)  # 0.26 is not


def test_a_caption_speaks_of_what_is_in_the_table() -> None:
    whole = preset(a_table(COLOR))
    for part in (
        "20 episodes per cell",
        "$K = 1$",
        "Bold: the best policy",
        r"cue\_blind: the same arm without",
        "tab:demo",
    ):
        assert part in whole
    alone = preset(a_table(COLOR, policies=("memory_color3",)))
    for part in ("Bold", "Controls", "$\\pm$", "error"):
        assert part not in alone
    assert r"chance, 1/N & 0.33 \\" in alone  # not measured, so it is said where it comes from


def test_several_runs_have_their_spread() -> None:
    groups = [episodes("p", "+" * n + "-" * (10 - n), run=run) for run, n in enumerate((5, 6, 7))]
    text = preset(build_table([stored(*groups)]))
    assert r"p & 0.60 $\pm$ 0.06 \\" in text and "standard error over the runs" in text


def test_settings_have_letters_which_the_caption_explains() -> None:
    runs = [
        stored(episodes("p", "+-"), env={"delay_steps": 5}),
        stored(episodes("p", "--"), path="runs/b", env={"delay_steps": 9}),
    ]
    text = preset(build_table(runs))
    assert r"p (a) & 0.50" in text and "p (b) & 0.00" in text
    assert r"Settings: (a) env.delay\_steps=5; (b) env.delay\_steps=9." in text


def test_the_controls_of_the_caption_are_the_scripted_policies() -> None:
    scripted = {name for name, code in POLICIES.items() if re.search("scripted|shortcuts", code)}
    assert set(CONTROLS) == scripted


@pytest.mark.skipif(PDFLATEX is None, reason="LaTeX is not installed")
@pytest.mark.parametrize("runs", [1, 2])
def test_latex_sets_the_tables_within_one_line_width(tmp_path: Path, runs: int) -> None:
    table = a_table(*TASKS, runs=runs)
    names = ("p", "a_policy_with_a_long_name")
    wide = [
        episodes(name, "+-", task=task, n_action_steps=k) for name in names for task in TASKS for k in (1, 4)
    ]
    narrow = [episodes("p", "+-", n_action_steps=k) for k in (1, 4)]
    body = [
        preset(table),
        *(render_sweep(compare_runs([stored(*groups)]), "latex") for groups in (wide, narrow)),
        r"\clearpage\typeout{WIDE FROM HERE}\tiny\hoffset-1in\hsize=40in\noindent",  # only that it compiles
        render(table, "latex", paper=True),
    ]
    packages = r"\documentclass{article}\usepackage{booktabs,graphicx}\begin{document}"
    source = "\n".join([packages, *body, r"\end{document}"])
    (tmp_path / "table.tex").write_text(source, encoding="utf-8")
    command = [PDFLATEX or "", "-interaction=nonstopmode", "-halt-on-error", "table.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
    widths = (tmp_path / "table.log").read_text(encoding="latin-1").partition("WIDE FROM HERE")[0]
    assert "Overfull" not in widths
    assert (tmp_path / "table.pdf").stat().st_size > 0


def test_a_comparison_says_once_what_all_its_rows_share() -> None:
    runs = [stored(*(episodes("p", "+-", n_action_steps=k) for k in (1, 4)))]
    above, _, table = render_sweep(compare_runs(runs), "latex").partition(r"\begin{tabular}")
    assert rf"All rows: task {COLOR}, policy p, episodes 2" in above
    assert "---" not in above  # no ceiling: a column of nothing is not there
    assert COLOR not in table and table.splitlines()[2].startswith("K & ")
    assert table.count(r"\midrule") == 1  # rules stand between tasks
