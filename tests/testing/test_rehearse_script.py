"""`make rehearse` stores each part, and runs again only what is not done with this version of the code."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.testing.script_files import SCRIPTS, load_script

PEAKS = {"write": 1_200_000_000, "load": 1_500_000_000, "act": 1_840_000_000}


def measured(name: str, **changes: Any) -> dict[str, Any]:
    """Return what a rehearsal of a recipe states, of Octo-small's size."""
    estimated = {"parameters": 136_670_604, "trained": 1_703_564, "peak_rss_bytes": {"write": 1_000_000_000}}
    return {
        "recipe": name,
        "dtype": "float32",
        "parameters": 136_670_604,
        "trained": 1_703_564,
        "bytes": 550_000_000,
        "peak_rss_bytes": PEAKS,
        "seconds": {"write": 17.2, "load": 48.0, "first_inference": 2.0, "second_inference": 1.6},
        "before_bytes": 920_000_000,
        "limit_bytes": 2_630_000_000,
        "is_within_limit": True,
        "estimated": estimated,
        **changes,
    }


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    module = load_script("rehearse")
    version = {"commit": "0123456789", "changes": None}
    monkeypatch.setattr(module, "checkout_state", lambda _: version)
    parts = ["octo_small", "convert-openvla"]
    monkeypatch.setattr(sys, "argv", ["rehearse", "--out", str(tmp_path), "--part", *parts])
    module.version = version
    return module


def test_a_part_is_run_again_at_another_commit_or_after_a_failure(
    script: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    asked: list[str] = []

    def run_part(name: str, options: Any) -> dict[str, Any]:
        asked.append(name)
        if name == "octo_small":
            return {"state": "done", "seconds": 1.0, "result": measured(name)}
        return {"state": "failed", "seconds": 2.0, "why": "killed"}

    monkeypatch.setattr(script, "run_part", run_part)
    assert script.main() == 1
    assert script.main() == 1
    assert asked == ["octo_small", "convert-openvla", "convert-openvla"]
    script.version["commit"] = "abcdef0123"
    assert script.main() == 1
    assert asked[3:] == ["octo_small", "convert-openvla"]
    assert set(json.loads((tmp_path / "rehearsal.json").read_text())) == {"octo_small", "convert-openvla"}
    printed = capsys.readouterr().out.splitlines()
    assert (
        "| `octo_small` | float32 | 136,670,604 | 1,703,564 | 0.55 GB | 17 s | 48 s | 2 s, 2 s "
        "| 0.92, 1.20, 1.50, 1.84 GB | 1.00, —, — GB | 2.63 GB |"
    ) in printed
    assert printed[-1] == "convert-openvla: failed: killed" and "at abcdef0 on" in printed[-2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, None),
        ({"parameters": 136_670_605}, "136,670,604 parameters of the published"),
        ({"peak_rss_bytes": {**PEAKS, "act": 2_630_000_001}}, "at most 2,630,000,000 bytes"),
    ],
)
def test_another_number_of_parameters_or_more_memory_than_allowed_is_a_failure(
    script: Any, changes: dict[str, Any], message: str | None
) -> None:
    found = script.problem("octo_small", measured("octo_small", **changes), tiny=False)
    assert found is None if message is None else message in found


def test_a_part_runs_in_a_process_of_its_own_and_says_why_it_cannot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(SCRIPTS))  # where the other process finds the script
    script = load_script("rehearse")
    options = script.Options(folder=tmp_path / "work", tiny=True)
    found = script.run_part("convert-openvla", options)
    assert found["state"] == "cannot run" and "--tiny" in found["why"]
