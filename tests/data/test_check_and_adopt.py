"""`dataset check` says what differs; `dataset adopt` takes back what LeRobot's own tool has edited."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from tests.data.foreign_datasets import write_good
from vla_eval.cli.main import main
from vla_eval.data.adopt import adopt
from vla_eval.data.check import check
from vla_eval.data.manifest import IMPORT_FILE
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError
from vla_eval.tasks.catalog import task_spec
from vla_eval.testing.synthetic import write_synthetic_dataset
from vla_eval.training.dataset import training_dataset

TASK = task_spec("RememberColor3-v0")
N_EPISODES = 5


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_dataset(tmp_path_factory.mktemp("ours") / "d", n_episodes=N_EPISODES, n_frames=4)


def actions(root: Path) -> list[np.ndarray]:
    """Return the actions of each episode."""
    rows = pd.concat(pd.read_parquet(path) for path in sorted(root.glob("data/*/*.parquet")))
    return [np.stack(list(part.action)) for _, part in rows.groupby("episode_index")]


def deleted(root: Path, out: Path) -> tuple[Path, list[int]]:
    delete_episodes(LeRobotDataset("local/d", root=root), [1, 3], output_dir=out, repo_id="local/deleted")
    return out, [0, 2, 4]


def split(root: Path, out: Path) -> tuple[Path, list[int]]:
    split_dataset(LeRobotDataset("local/d", root=root), {"a": [0, 1], "b": [2, 3, 4]}, output_dir=out)
    return out / "b", [2, 3, 4]


def merged(root: Path, out: Path) -> tuple[Path, list[int]]:
    split_dataset(LeRobotDataset("local/d", root=root), {"a": [0, 1], "b": [2, 3, 4]}, output_dir=out)
    parts = [LeRobotDataset(f"local/{name}", root=out / name) for name in ("b", "a")]
    merge_datasets(parts, output_repo_id="local/merged", output_dir=out / "merged")
    return out / "merged", [2, 3, 4, 0, 1]


@pytest.mark.sampled(3)
@pytest.mark.parametrize("edit", [deleted, split, merged])
def test_what_lerobots_tool_leaves_can_be_adopted_and_trained_on(
    ours: Path, tmp_path: Path, edit: Callable[[Path, Path], tuple[Path, list[int]]]
) -> None:
    root, numbers = edit(ours, tmp_path / "out")
    assert check(root).next_step == f"mikasa-vla dataset adopt {root}"
    with pytest.raises(DatasetError, match="not a complete dataset"):
        training_dataset(root, allow_unreplayed=True)

    facts = adopt(root, task=TASK)

    expected = [actions(ours)[number] for number in numbers]
    assert [one.tolist() for one in actions(root)] == [one.tolist() for one in expected]
    stats = json.loads((root / "meta/stats.json").read_text())
    all_rows = np.concatenate(expected).astype(np.float64)
    assert stats["action"]["q99"] == pytest.approx(np.quantile(all_rows, 0.99, axis=0))
    assert "q99" not in stats["observation.images.base"]
    assert [episode.n_steps for episode in facts.episodes] == [len(one) for one in expected]
    assert (facts.source_layout, facts.task, facts.control_mode) == ("adopted", TASK.id, "pd_ee_delta_pose")
    assert {episode.source_seed for episode in facts.episodes} == {None}
    found = training_dataset(root, allow_unreplayed=True)
    assert (found.seeds, found.was_replayed, found.facts.state) == (None, False, "eef")
    report = check(root)
    assert report.kind == "an adopted dataset, complete" and not report.is_refused
    with pytest.raises(DatasetError, match="the dataset has its records"):
        adopt(root, task=TASK)


def test_files_that_are_changed_after_an_adoption_are_found(ours: Path, tmp_path: Path) -> None:
    root = shutil.copytree(ours, tmp_path / "copy")
    adopt(root, task=None)
    video = next(root.glob("videos/*/*/*.mp4"))
    video.write_bytes(video.read_bytes()[:-1] + b"x")
    with pytest.raises(DatasetError, match=r"\.mp4: its content is not what was converted"):
        check(root)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda stats: stats.pop("observation.images.base"), "recompute_stats"),
        (lambda stats: None, ""),
    ],
)
def test_statistics_of_images_are_needed_for_an_adoption(
    ours: Path, tmp_path: Path, change: Callable[[dict[str, Any]], Any], words: str
) -> None:
    root = shutil.copytree(ours, tmp_path / "copy")
    stats = json.loads((root / "meta/stats.json").read_text())
    change(stats)
    (root / "meta/stats.json").write_text(json.dumps(stats))
    if not words:
        assert adopt(root, task=None).is_checked
        return
    with pytest.raises(DatasetError, match=words):
        adopt(root, task=None)
    assert not (root / IMPORT_FILE).exists()


def test_a_dataset_with_other_fields_is_sent_to_convert(tmp_path: Path) -> None:
    root = write_good(tmp_path / "foreign", "image")
    with pytest.raises(DatasetError, match="dataset convert"):
        adopt(root, task=None)


class TestCheck:
    def test_a_good_dataset_of_others_names_the_next_step(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        root = write_good(tmp_path / "foreign", "video")
        assert main(["dataset", "check", str(root)]) == 0
        said = capsys.readouterr().out
        assert "3 episodes, 11 frames, 20 per second" in said
        assert "sentence: 'lift the block' (9 frames)" in said
        assert f"next: mikasa-vla dataset convert {root} --to lerobot --out DIR" in said

    def test_all_that_has_to_be_changed_is_said_at_once(
        self, ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        root = shutil.copytree(ours, tmp_path / "copy")
        path = root / "data/chunk-000/file-000.parquet"
        rows = pd.read_parquet(path)
        rows["action"] = [row * 3 for row in rows["action"]]
        rows.loc[5, "task_index"] = 1 - rows.loc[5, "task_index"]
        rows.to_parquet(path)

        assert main(["dataset", "check", str(root)]) == 1

        captured = capsys.readouterr()
        assert captured.out.count("refused: ") == 2
        assert "expected one sentence per episode" in captured.out
        assert "meta/stats.json differs from the rows: min of action" in captured.out
        assert "2 of these have to be changed" in captured.err

    def test_videos_of_another_dataset_are_found_by_their_headers(self, ours: Path, tmp_path: Path) -> None:
        root = shutil.copytree(ours, tmp_path / "copy")
        short = write_synthetic_dataset(tmp_path / "short", n_episodes=1, n_frames=2)
        base, wrist = (
            f"videos/observation.images.{name}/chunk-000/file-000.mp4" for name in ("base", "wrist")
        )
        shutil.copy(short / base, root / base)
        foreign = write_good(tmp_path / "foreign", "video")
        info = json.loads((root / "meta/info.json").read_text())
        info["features"]["observation.images.wrist"]["shape"] = [64, 64, 3]
        (root / "meta/info.json").write_text(json.dumps(info))

        refused = [said.sentence for said in check(root).said if said.answer == "refused"]

        n_frames = sum(len(rows) for rows in actions(ours))
        assert f"{base}: has 2 frames, its {N_EPISODES} episodes need {n_frames}." in refused
        assert f"{wrist}: its frames are 128 × 128 px, expected 64 × 64 (meta/info.json)." in refused
        assert not check(foreign).is_refused

    def test_a_dataset_that_cannot_be_imported_is_still_looked_at(self, tmp_path: Path) -> None:
        root = tmp_path / "aloha"
        numbers = {"dtype": "float32", "shape": (14,), "names": None}
        dataset = LeRobotDataset.create(
            "local/aloha", fps=50, root=root, features={"observation.state": numbers, "action": numbers}
        )
        for step in range(3):
            row = np.full(14, np.inf if step == 2 else step, np.float32)
            dataset.add_frame({"observation.state": row, "action": row, "task": "fold"})
        dataset.save_episode()
        dataset.finalize()

        report = check(root)

        sentences = " ".join(said.sentence for said in report.said if said.answer == "refused")
        assert report.is_refused
        for words in ("expected the cameras", "It has 50 frames per second", "episode 0, frame 2: "):
            assert words in sentences

    def test_version_2_1_names_lerobots_converter(self, tmp_path: Path) -> None:
        (tmp_path / "meta").mkdir()
        (tmp_path / "data/chunk-000").mkdir(parents=True)
        info = {"codebase_version": "v2.1", "fps": 20, "features": {}, "total_episodes": 1}
        (tmp_path / "meta/info.json").write_text(json.dumps(info))
        (tmp_path / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "lift"}')
        pd.DataFrame({"action": [0.0]}).to_parquet(tmp_path / "data/chunk-000/episode_000000.parquet")
        with pytest.raises(DatasetError, match=r"version v2\.1.*convert_dataset_v21_to_v30"):
            check(tmp_path)

    def test_npz_files_are_checked_too(self, tmp_path: Path) -> None:
        joints = np.zeros((3, 25), np.float32)
        np.savez(
            tmp_path / "train_data_0.npz",
            rgb=np.zeros((3, 128, 128, 6), np.uint8),
            joints=joints,
            action=np.full((3, 7), -1.0, np.float32),
        )
        report = check(tmp_path)
        refused = " ".join(said.sentence for said in report.said)
        assert "quaternion of proprio.joints is of length 0" in refused
        assert "the language instruction is None" in refused and report.kind == "1 npz files"


def test_opening_what_was_adopted_serves_the_frames_of_each_episode(ours: Path, tmp_path: Path) -> None:
    root, numbers = deleted(ours, tmp_path / "out")
    adopt(root, task=None)
    before, after = open_local_dataset(ours), open_local_dataset(root)
    firsts = before.meta.episodes["dataset_from_index"]
    for number, first in zip(numbers, after.meta.episodes["dataset_from_index"], strict=True):
        there, here = before[firsts[number]], after[first]
        difference = there["observation.images.base"] - here["observation.images.base"]
        assert float(difference.abs().mean()) < 0.05  # encoded a second time
        assert there["task"] == here["task"]
