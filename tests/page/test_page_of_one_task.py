"""What a page of one task leaves out, and what pages of several share."""

import re

from tests.page.test_report_page import COLOR, INTERCEPT, Page, episode, stored
from vla_eval.page.build import build_page


def test_how_chance_is_compared_is_explained_only_where_it_was() -> None:
    def verdict(*policies: str) -> str:
        return Page(build_page([stored(*(episode(name, 1, True) for name in policies))])).sections["verdict"]

    assert "McNemar" in verdict("p", "cue_blind")
    assert "McNemar" not in verdict("p", "twin")


def test_a_row_is_called_by_its_task_only_where_there_are_several() -> None:
    alone = Page(build_page([stored(episode("p", 1, True))])).sections["choices"]
    assert COLOR not in alone and "p · K=1" in alone
    both = stored(episode("p", 1, True), episode("p", 1, True, task=INTERCEPT))
    assert f"{COLOR} · p · K=1" in Page(build_page([both])).sections["choices"]


def test_the_axes_of_all_tasks_begin_at_the_same_place() -> None:
    run = stored(
        *(episode(name, seed, True) for name in ("p", "a_policy_with_a_long_name") for seed in (1, 2)),
        *(episode("p", seed, True, task=INTERCEPT) for seed in (1, 2)),
    )
    section = re.search(r'<section id="success">(.*?)</section>', build_page([run]), re.S)
    assert section is not None
    sizes = re.findall(r'<svg viewBox="0 0 ([\d.]+) [^>]*class="wide"', section[1])
    # The axis is equally wide, so the room for labels is, too.
    assert len(sizes) == 2 and len(set(sizes)) == 1
