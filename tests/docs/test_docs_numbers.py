"""Numbers and sentences of the docs that need no run, made again by the project's own functions."""

import re
from pathlib import Path

from tests.results import stored_runs
from vla_eval.results.estimates import LEVEL, wilson_interval
from vla_eval.results.report import audit_notes
from vla_eval.results.sweep import discordance_of_independent, episodes_to_settle

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "measuring.md").read_text(encoding="utf-8")
CHANCES = (1 / 3, 1 / 5, 1 / 9)


def rows(heading: str) -> list[list[str]]:
    """Return the cells of the first table whose head begins so."""
    table = PAGE.split(f"| {heading} |", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def test_so_many_successes_lie_above_chance() -> None:
    for episodes, *cells in rows("episodes"):
        for chance, cell in zip(CHANCES, cells, strict=True):
            n_success = int(cell)
            assert wilson_interval(n_success, int(episodes)).low > chance
            assert wilson_interval(n_success - 1, int(episodes)).low <= chance


def test_so_many_episodes_find_a_difference() -> None:
    for text, *cells in rows("difference"):
        for base, cell in zip(CHANCES, cells, strict=True):
            difference = float(text)
            discordance = discordance_of_independent(base, base + difference)
            wanted = [
                episodes_to_settle(difference, discordance, level=LEVEL / n_tests) for n_tests in (1, 10)
            ]
            assert [int(number) for number in re.findall(r"\d+", cell)] == wanted


def test_the_readme_quotes_the_audit_that_ships() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    records = stored_runs.episodes("oracle", "+", task="RememberColor3-v0")
    (note,) = audit_notes([stored_runs.stored(records)])
    assert f"- {note}" in readme
