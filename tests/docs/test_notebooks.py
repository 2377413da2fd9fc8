"""The notebooks of the documentation: they run as they stand, and their stored outputs are whole."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scripts.notebooks import as_markdown, read
from tests.forked import run_forked

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
SMALL = {
    re.compile(r"episodes=\d+"): 'episodes=1, simulator="fake", in_process=True',
    re.compile("delays=.0, 5, 20."): "delays=[0]",
}
MACHINE = re.compile(r"/(?:home|work|tmp|root|Users)/|0x[0-9a-f]{6,}")


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def small(source: list[str]) -> list[str]:
    text = "".join(source)
    for shown, instead in SMALL.items():
        text = shown.sub(instead, text)
    return [text]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_the_first_cell_to_the_last(path: Path, tmp_path: Path) -> None:
    notebook = read(path)
    for cell in code_cells(notebook):
        cell.update(source=small(cell["source"]), outputs=[], execution_count=None)
    assert 'simulator="fake"' in json.dumps(notebook).replace('\\"', '"')
    copy = tmp_path / path.name
    copy.write_text(json.dumps(notebook), encoding="utf-8")
    program = str(ROOT / "scripts" / "notebooks.py")
    if path.stem == "your_policy":
        done = subprocess.run(
            [sys.executable, program, str(copy)], cwd=tmp_path, capture_output=True, text=True
        )
    else:  # in a process that has imported what a model needs
        arguments = [program, "--here", str(copy)]
        script = (
            f"import runpy, sys; sys.argv = {arguments}; runpy.run_path({program!r}, run_name='__main__')"
        )
        done = run_forked(script, tmp_path)
    assert done.returncode == 0, done.stderr
    for ran, stored in zip(code_cells(read(copy)), code_cells(read(path)), strict=True):
        assert kinds(ran) == kinds(stored), "".join(stored["source"])


def kinds(cell: dict[str, Any]) -> list[list[str]]:
    return [sorted(output.get("data", {"text": ""})) for output in cell["outputs"]]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_outputs_are_those_of_one_run_in_order_and_name_no_machine(path: Path) -> None:
    cells = code_cells(read(path))
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert sum(bool(cell["outputs"]) for cell in cells) > len(cells) / 3
    assert MACHINE.findall(path.read_text(encoding="utf-8")) == []
    assert all(output["output_type"] != "error" for cell in cells for output in cell["outputs"])


def test_your_policy_takes_ten_cells() -> None:
    assert len(code_cells(read(ROOT / "docs" / "notebooks" / "your_policy.ipynb"))) == 10


def test_the_page_of_a_notebook_has_its_text_its_code_and_what_cells_show() -> None:
    shown = {
        "output_type": "execute_result",
        "data": {"text/html": ["<b>\n", "\n", "  x</b>"], "text/plain": "x"},
    }
    printed = {"output_type": "stream", "name": "stdout", "text": ["a\n", "b\n"]}
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "text"]},
        {"cell_type": "code", "source": ["x"], "outputs": [printed, shown]},
    ]
    assert as_markdown({"cells": cells}) == (
        "# Title\ntext\n\n```python\nx\n```\n\n```text\na\nb\n```\n\n"
        '<div class="output">\n<b>\nx</b>\n</div>\n'
    )
