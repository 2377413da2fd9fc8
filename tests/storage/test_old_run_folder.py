"""A run folder of version 0.1.0, whose configuration says `recording`: read, viewed, resumed.

`tests/golden/old_run/README.md` says where the stored folder comes from.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from vla_eval.cli.main import main
from vla_eval.storage.run_folder import read_run
from vla_eval.strict.decoding import warn_renamed

STORED = Path(__file__).parents[1] / "golden" / "old_run"
CAPTURED = "RememberColor3-v0_scripted_K1_run0_seed1_failure"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The stored folder, beside its recipes, with the files that the old version captured."""
    shutil.copytree(STORED, tmp_path, dirs_exist_ok=True)
    for folder, ending in (("videos", "mp4"), ("videos", "jpg"), ("rrd", "rrd")):
        (tmp_path / "run" / folder).mkdir(exist_ok=True)
        (tmp_path / "run" / folder / f"{CAPTURED}.{ending}").write_bytes(b"captured by the old version")
    monkeypatch.chdir(tmp_path)
    warn_renamed.cache_clear()
    yield tmp_path / "run"
    warn_renamed.cache_clear()


def test_it_is_reported_on_with_its_video(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(run), "--html", str(tmp_path / "page")]) == 0
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "1 of 1 captured episodes" in page
    assert "--record-video 1" in page  # the command that made it, as it was typed


def test_its_rerun_file_is_found(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(run), "--print"]) == 0
    assert capsys.readouterr().out.strip() == str(run / "rrd" / f"{CAPTURED}.rrd")


def test_the_same_command_resumes_it(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    stored = (run / "episodes.jsonl").read_text(encoding="utf-8")
    command = ["eval", "captured", "--out", str(run), "--record-video", "2", "--allow-environment-change"]
    assert main(command) == 0

    assert "'recording' is now called 'capture'" in caplog.text
    assert "--record-video is now called --capture-video" in caplog.text
    assert (run / "episodes.jsonl").read_text(encoding="utf-8").startswith(stored)
    assert [record.seed for record in read_run(run).records] == [1, 2]
    assert (run / "videos" / f"{CAPTURED.replace('seed1', 'seed2')}.mp4").exists()
    sessions = json.loads((run / "run.json").read_text(encoding="utf-8"))["sessions"]
    assert sessions[0]["options"]["recording"] == {"video": 1, "rrd": 1, "frame_stride": 2}
    now = {"video": 2, "rrd": 1, "strip": "none", "memory": False, "frames": False, "frame_stride": 2}
    assert sessions[1]["options"]["capture"] == now


def test_the_new_names_resume_it_without_a_warning(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = run.parent / "configs" / "captured.yaml"
    config.write_text(config.read_text(encoding="utf-8").replace("recording:", "capture:"), encoding="utf-8")
    command = ["eval", "captured", "--out", str(run), "--capture-video", "2", "--allow-environment-change"]
    assert main(command) == 0
    assert "is now called" not in caplog.text
    assert [record.seed for record in read_run(run).records] == [1, 2]
