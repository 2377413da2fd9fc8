"""`docs/leaderboard.md` is what its script generates from the published results."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_of_published_results_is_up_to_date() -> None:
    path = ROOT / "scripts" / "leaderboard_page.py"
    spec = importlib.util.spec_from_file_location("leaderboard_page", path)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.PAGE.read_text(encoding="utf-8") == script.page(), "run scripts/leaderboard_page.py"
