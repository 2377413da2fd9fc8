"""Names that would be formulas, markup or a second line are none in what report and compare write."""

import csv
import io
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.results.stored_runs import episodes, stored
from vla_eval.page.build import build_page
from vla_eval.results.cells import markdown_block, markdown_code
from vla_eval.results.report import build_table, render
from vla_eval.results.sweep import compare_runs
from vla_eval.results.sweep_format import render_sweep
from vla_eval.storage.run_folder import StoredRun

FORMULAS = ("=cmd|' /C calc'!A0", "+1+cmd", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "\n=1")
MARKUP = (
    "a|b",
    "a\\|b",
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "x`y",
    "a\nb|c",
    "a\r\nb",
)
LATEX = ("50%_&#$~^{}", "$\\alpha", "[2]", "*", "\\input{x}", "a\n\nb", "$x^$")
NAMES = (*FORMULAS, *MARKUP, *LATEX)


def run_of(name: str) -> StoredRun:
    """A run whose task, policy and folder have this name."""
    groups = [episodes(name, "+-+-", task=name, n_action_steps=k) for k in (1, 2)]
    return stored(*groups, path=f"runs/{name}")


def outputs(run: StoredRun, fmt: str) -> list[str]:
    table = render(build_table([run]), fmt)  # type: ignore[arg-type]
    return [table, render_sweep(compare_runs([run]), fmt)]  # type: ignore[arg-type]


@pytest.mark.parametrize("name", NAMES)
def test_no_cell_of_a_csv_is_a_formula(name: str) -> None:
    for text in outputs(run_of(name), "csv"):
        titles, *rows = csv.reader(io.StringIO(text, newline=""))
        assert len(rows) == 2 == text.count("\n")
        for row in rows:
            assert len(row) == len(titles)
            for cell in row:
                assert not cell.startswith(("=", "@", "\t", "\r", "\n"))
                assert not cell.startswith(("+", "-")) or re.fullmatch(r"[+-]\d+(\.\d+)?(e-?\d+)?", cell)


def test_a_negative_number_stays_a_number_and_a_name_keeps_its_letters() -> None:
    run = stored(episodes("random", "++++"), episodes("-2+3", "----"), path="runs/a")
    _, *rows = csv.DictReader(io.StringIO(render(build_table([run], baseline="random"), "csv"))), None
    by_policy = {row["policy"]: row for row in csv.DictReader(io.StringIO(render(build_table([run]), "csv")))}
    assert rows == [None]
    assert by_policy["'-2+3"]["paired_difference"] == "-1.0"
    assert set(by_policy) == {"random", "'-2+3"}


@pytest.mark.parametrize("name", NAMES)
def test_a_row_of_markdown_is_one_line_with_all_its_cells(name: str) -> None:
    for text in outputs(run_of(name), "markdown"):
        lines = [line for line in text.split("\n") if line.startswith("|")]
        assert len(lines) == 4  # titles, rule, two rows
        assert len({len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) for line in lines}) == 1
        assert all(line == "" or line.startswith(("|", "- ", "All rows: ")) for line in text.split("\n"))
        assert not re.search(r"<[A-Za-z/!?]", text)


@pytest.mark.parametrize("name", ["[a](http://b)", "![a][b]", "`a`", "**a**", "a](b"])
def test_no_cell_of_markdown_is_a_link_or_code_or_bold(name: str) -> None:
    for text in outputs(run_of(name), "markdown"):
        cells = "".join(line for line in text.split("\n") if line.startswith(("|", "All rows: ")))
        acting = re.sub(r"\\.", "", cells)
        assert not re.search(r"\]\(|\]\[|`|\*", acting)


def test_code_and_blocks_of_markdown_end_where_they_should() -> None:
    assert markdown_code("a`b``c|d") == "``` a`b``c\\|d ```"
    assert markdown_block("a: |\n  ```\n  # out\n", "yaml") == "````yaml\na: |\n  ```\n  # out\n````"
    assert markdown_block("a", "yaml") == "```yaml\na\n```"


@pytest.mark.parametrize("name", NAMES)
def test_latex_s_own_characters_are_escaped(name: str) -> None:
    for text in outputs(run_of(name), "latex"):
        check_latex_rows([line for line in text.split("\n") if line.endswith(" \\\\")])


def check_latex_rows(rows: list[str]) -> None:
    assert len(rows) == 3  # titles, two rows
    for row in rows:
        assert not row.startswith(("[", "*"))
        assert row.count(" & ") == rows[0].count(" & ")
        known = re.sub(r"\\[_%&#${}]|\\text(backslash|asciitilde|asciicircum)\{\}|\$(<|>|-|\\pm)\$", "", row)
        known = re.sub(r"\\texttt\{(.*?)\}", r"\1", known.removesuffix(" \\\\")).replace(" & ", "")
        assert not set("\\%&#$~^") & set(known.replace("$^\\dagger$", "").replace("$\\times$", ""))


@pytest.mark.parametrize("name", NAMES)
def test_an_html_table_has_only_its_own_elements(name: str) -> None:
    allowed = {"p", "table", "thead", "tbody", "tr", "th", "td", "ul", "li", "code"}
    for text in outputs(run_of(name), "html-table"):
        found = _Tags(text).found
        assert {tag for tag, _ in found} <= allowed
        assert {attribute for _, attributes in found for attribute in attributes} <= {"style"}
        assert [tag for tag, _ in found].count("tr") == 3  # titles, two rows


class _Tags(HTMLParser):
    """Collects the names of a page's elements and of their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, tuple[str, ...]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, tuple(name for name, _ in attrs)))


@pytest.mark.parametrize(
    "name", ["<img src=x onerror=alert(1)>", "$x^$", "\" onclick='x", "</script><b>", "a\nb"]
)
def test_names_are_no_elements_of_the_page(name: str, tmp_path: Path) -> None:
    hostile = [found for found in _Tags(build_page([run_of(name)])).found if found[0] not in ("use", "path")]
    harmless = [
        found for found in _Tags(build_page([run_of("name")])).found if found[0] not in ("use", "path")
    ]
    assert hostile == harmless
