"""What tables and headings of a page say, and in which order."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.page.test_report_page import COLOR, episode, full_page, full_run
from vla_eval.page import machine_sections
from vla_eval.results.sweep import compare_runs
from vla_eval.results.sweep_format import render_sweep


def test_latencies_are_in_the_order_of_policy_then_k(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = SimpleNamespace(median_seconds=1.0, slowest_seconds=1.0, n_episodes=1, episode_seconds=1.0)
    monkeypatch.setattr(machine_sections, "measure_latency", lambda *_: measured)
    records = [episode(policy, 1, True, k=k) for k in (8, 1, 16) for policy in ("mine", "oracle")]
    run = SimpleNamespace(records=records, path=Path("runs/a"))
    material: Any = SimpleNamespace(runs=[run], tasks=[COLOR], timings={"runs/a": None})

    rows = machine_sections.latency(material).table.rows

    assert [row[0] for row in rows] == [
        *(f"mine · K={k}" for k in (1, 8, 16)),
        *(f"oracle · K={k}" for k in (1, 8, 16)),
    ]


def test_a_wrong_choice_is_not_said_to_be_forgotten() -> None:
    page = full_page()
    assert "wrong choice" in page and ">forgot<" not in page


def test_the_header_says_which_difference_the_episodes_settle() -> None:
    sweep = compare_runs([full_run()], by="policy", difference=0.15)
    assert "episodes to settle ±0.15" in render_sweep(sweep, "markdown")
