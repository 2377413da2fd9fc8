"""`make gpu-check` stores each part, resumes with the next one, and says why a part cannot run."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.testing.script_files import SCRIPTS, load_script


@pytest.fixture
def script() -> Any:
    return load_script("gpu_check")


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


def test_all_ports_are_compared_with_their_originals_and_agree_in_float32(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "tests", sys.modules["tests"])  # put back what the script replaces
    monkeypatch.syspath_prepend(str(SCRIPTS))
    found = load_script("golden_differences").compare("cpu")
    differences, tolerances = found["largest_differences"], found["tolerances_in_tests"]
    assert set(differences) == set(tolerances) == {"openvla_oft", "spatialvla", "octo"}
    for model, tolerated in tolerances.items():
        assert set(differences[model]) == {"float32", "float32, TF32", "bfloat16"}
        for name, limit in tolerated.items():
            assert differences[model]["float32"][name] <= limit
        assert max(differences[model]["bfloat16"].values()) > max(tolerated.values())  # it had an effect
