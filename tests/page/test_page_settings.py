"""Run folders with other settings on one page."""

import re
from dataclasses import replace
from pathlib import Path

from tests.page.test_report_page import Page, episode, stored
from vla_eval.page.build import build_page


def test_settings_in_which_run_folders_differ_are_said_once_and_named_by_a_letter() -> None:
    one = stored(*(episode("p", seed, True) for seed in range(3)))
    config = {**one.description.config, "stop_at_success": True}
    other = replace(one, path=Path("runs/other"), description=replace(one.description, config=config))
    page = build_page([one, other])
    assert "(b) stop_at_success=true.</p>" in page
    labels = re.findall(r"<text[^>]*>(p · [^<]*)</text>", page)
    assert set(labels) == {"p · K=1 (a)", "p · K=1 (b)"}


def test_how_the_rows_were_made_is_on_the_page_with_each_value_that_differs() -> None:
    runs = [stored(episode("p", k, True, k=k), path=Path(f"runs/{k}")) for k in (1, 4)]
    lines = Page(build_page(runs)).sections["passport"].splitlines()
    made = " ".join(" ".join(line.split()) for line in lines)
    assert "K 1; 4" in made and "seeds 1; 4" in made and "python=3.12.1" in made
    assert "horizon unknown" in made  # these runs do not say
