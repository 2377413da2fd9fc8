"""`make gpu-check` stores each part, resumes with the next one, and says why a part cannot run."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "gpu_check.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("gpu_check", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "gpu_check", module)
    spec.loader.exec_module(module)
    return module


def test_parts_are_stored_and_only_failed_ones_run_again(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def works(check: Any) -> dict[str, Any]:
        asked.append("works")
        return {"figure": 3}

    def refuses(check: Any) -> dict[str, Any]:
        asked.append("refuses")
        raise script.CannotRunError("no GPU here")

    def fails(check: Any) -> dict[str, Any]:
        asked.append("fails")
        raise ValueError("mistake")

    monkeypatch.setattr(script, "PARTS", {"works": works, "refuses": refuses, "fails": fails})
    monkeypatch.setattr(sys, "argv", ["gpu_check", "--device", "cpu", "--tiny", "--out", str(tmp_path)])
    assert script.main() == 1
    assert script.main() == 1
    assert asked == ["works", "refuses", "fails", "fails"]
    stored = json.loads((tmp_path / "gpu_check.json").read_text())
    assert stored["works"]["result"] == {"figure": 3} and stored["works"]["state"] == "done"
    assert stored["refuses"] == {**stored["refuses"], "state": "cannot run", "why": "no GPU here"}
    assert stored["fails"]["why"] == "ValueError: mistake"
    page = (tmp_path / "gpu_check.md").read_text()
    assert "these figures only show that the script runs" in page and "no GPU here" in page
