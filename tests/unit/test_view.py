"""`mikasa-vla view`: which recordings it finds, and what it says where there are none."""

from pathlib import Path

import pytest

from vla_eval.cli.main import main
from vla_eval.results.recording_files import rrd_file
from vla_eval.results.records import EpisodeRecord
from vla_eval.results.store import RunDescription, RunFolder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three episodes each of two policies; the first two seeds of `p` are recorded."""
    path = tmp_path / "run"
    description = RunDescription(name="a", config={}, recipes={}, environment={}, options={}, command="")
    with RunFolder.open(path, description) as run:
        for policy in ("p", "q"):
            for seed in (1, 2, 3):
                record = EpisodeRecord(
                    task="RememberColor3-v0", policy=policy, n_action_steps=1, run=0, seed=seed,
                    outcome="success", success_once=True,
                )  # fmt: skip
                run.append(record)
                if policy == "p" and seed < 3:
                    rrd_file(path, record).parent.mkdir(exist_ok=True)
                    rrd_file(path, record).write_bytes(b"")
    return path


def test_it_prints_the_recordings_of_the_seed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder), "--seed", "2", "--print"]) == 0
    name = "RememberColor3-v0_p_K1_run0_seed2_success.rrd"
    assert capsys.readouterr().out == f"{folder / 'rrd' / name}\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seed", "3"], "none was recorded. Seeds with a recording: 1, 2."),
        (["--seed", "99"], "no such episode. Seeds with a recording: 1, 2."),
        (["--task", "RememberColour3-v0"], "Did you mean 'RememberColor3-v0'?"),
    ],
)
def test_what_is_not_there_is_answered(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["view", str(folder), *arguments, "--print"]) == 1
    assert said in capsys.readouterr().err


def test_a_run_without_recordings_says_how_to_make_some(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in (folder / "rrd").iterdir():
        file.unlink()
    assert main(["view", str(folder)]) == 1
    assert "--record-rrd all|failures|successes|N" in capsys.readouterr().err


def test_without_a_screen_it_says_what_else_can_be_done(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(folder)]) == 1
    assert "--web" in capsys.readouterr().err


def test_a_dataset_is_shown_by_lerobots_viewer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    assert main(["view", str(tmp_path)]) == 1
    assert "lerobot-dataset-viz" in capsys.readouterr().err
