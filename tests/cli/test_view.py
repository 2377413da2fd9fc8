"""`mikasa-vla view`: which rerun files it finds, and what it says where there are none."""

import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rerun.experimental import RrdReader

from vla_eval.cli.main import main
from vla_eval.cli.view import cache_place
from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import rrd_file
from vla_eval.storage.run_folder import RunDescription, RunFolder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three episodes each of two policies; the first two seeds of `p` are captured."""
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


def test_it_prints_the_rerun_files_of_the_seed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder), "--seed", "2", "--print"]) == 0
    name = "RememberColor3-v0_p_K1_run0_seed2_success.rrd"
    assert capsys.readouterr().out == f"{folder / 'rrd' / name}\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seed", "3"], "none was captured. Seeds with a rerun file: 1, 2."),
        (["--seed", "99"], "no such episode. Seeds with a rerun file: 1, 2."),
        (["--task", "RememberColour3-v0"], "Did you mean 'RememberColor3-v0'?"),
    ],
)
def test_what_is_not_there_is_answered(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["view", str(folder), *arguments, "--print"]) == 1
    assert said in capsys.readouterr().err


def test_a_run_without_rerun_files_says_how_to_make_some(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in (folder / "rrd").iterdir():
        file.unlink()
    assert main(["view", str(folder)]) == 1
    assert "--capture-rrd all|failures|successes|N" in capsys.readouterr().err


def test_without_a_screen_it_says_what_else_can_be_done(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(folder)]) == 1
    assert "--web" in capsys.readouterr().err


class TestDataset:
    @pytest.fixture(autouse=True)
    def cache_of_its_own(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def curves(self, path: Path) -> dict[str, list[float]]:
        """Return each curve of a rerun file, as rerun's own reader gives it, in the order of steps."""
        found: dict[str, dict[int, float]] = {}
        for chunk in RrdReader(path).store().stream().to_chunks():
            batch = chunk.to_record_batch().to_pydict()
            if "Scalars:scalars" in batch:
                values = [value for (value,) in batch["Scalars:scalars"]]
                found.setdefault(chunk.entity_path, {}).update(zip(batch["step"], values, strict=True))
        return {entity: [points[step] for step in sorted(points)] for entity, points in found.items()}

    def test_an_episode_is_shown_with_its_pictures_numbers_and_phases(
        self, recorded: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["view", str(recorded), "--episode", "1", "--print"]) == 0
        path = Path(capsys.readouterr().out.strip())
        assert path.name == "episode_000001.rrd" and not list(path.parent.glob("*.part"))

        table = pd.read_parquet(next(recorded.glob("data/*/*.parquet")))
        rows = table[table["episode_index"] == 1]
        curves = self.curves(path)
        stored = np.stack(rows["action"].to_list())
        for dim, name in enumerate(("dx", "dy", "dz", "drx", "dry", "drz", "gripper")):
            np.testing.assert_array_equal(curves[f"/actions/{name}/stored"], stored[:, dim])
        x = np.stack(rows["observation.state"].to_list())[:, 0]
        np.testing.assert_array_equal(curves["/state/x"], x)
        # 14 frames: 5 of the cue, 5 of the delay, and the rest.
        phases = {name: curves[f"/phase/{name}"] for name in ("cue", "delay", "response")}
        assert phases["cue"] == [1.0] * 5 + [0.0] * 9
        assert phases["delay"] == [0.0] * 5 + [1.0] * 5 + [0.0] * 4
        assert phases["response"] == [0.0] * 10 + [1.0] * 4
        entities = set(RrdReader(path).store().schema().entity_paths())
        assert {"/cameras/base", "/cameras/wrist", "/world/tcp", "/world/tcp_path"} <= entities
        assert {"/reward", "/success", "/events", "/instruction"} <= entities
        assert len(RrdReader(path).blueprints()) == 1

    def test_without_a_choice_the_first_are_shown_and_a_seed_picks_one(
        self, recorded: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["view", str(recorded), "--print"]) == 0
        names = [Path(line).name for line in capsys.readouterr().out.split()]
        assert names == [f"episode_{number:06d}.rrd" for number in range(4)]
        # Seeds 1000, 1001, 1003, 1004.
        assert main(["view", str(recorded), "--seed", "1003", "--print"]) == 0
        assert Path(capsys.readouterr().out.strip()).name == "episode_000002.rrd"

    def test_the_folder_that_record_was_given_is_its_one_dataset(
        self, recorded: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["view", str(recorded.parent), "--print"]) == 0
        assert len(capsys.readouterr().out.splitlines()) == 4

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["--episode", "4"], "there is no episode 4; they are 0 to 3."),
            (["--seed", "1002"], "no episode of seed 1002. Its seeds: 1000, 1001, 1003, 1004."),
            (["--policy", "p"], "is a dataset; --policy is of runs."),
        ],
    )
    def test_what_it_does_not_have_is_answered(
        self, recorded: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
    ) -> None:
        assert main(["view", str(recorded), *arguments, "--print"]) == 1
        assert said in capsys.readouterr().err

    def test_a_dataset_that_nobody_recorded_here_is_shown_without_phases(
        self, recorded: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        shutil.rmtree(recorded / "meta" / "mikasa")
        assert main(["view", str(recorded), "--episode", "0", "--print"]) == 0
        curves = self.curves(Path(capsys.readouterr().out.strip()))
        assert "/actions/dx/stored" in curves and not any(name.startswith("/phase") for name in curves)


def test_a_run_has_no_numbered_episodes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder), "--episode", "0", "--print"]) == 1
    assert "--episode is of datasets" in capsys.readouterr().err


def test_a_dataset_whose_folder_s_name_is_no_utf_8_has_a_place_in_the_cache(tmp_path: Path) -> None:
    one, other = (tmp_path / os.fsdecode(name) for name in (b"\xfc", b"\xfd"))
    assert cache_place(one) != cache_place(other)
