"""An episode's statistics are LeRobot's, but for its rounding."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets import compute_stats, video_utils
from numpy.typing import NDArray

from vla_eval.data.recording.episode_statistics import ExactStatistics
from vla_eval.data.recording.shard_writer import new_dataset
from vla_eval.features import EncoderSettings

LEROBOTS = ExactStatistics.__bases__[0]  # whatever the module's name now stands for
SHARES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
VIDEO = "observation.images.base_camera"
EDGE_PX = 32


def frames(n: int = 6, *, greatest: int = 256, least: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(n).integers(least, greatest, (n, EDGE_PX, EDGE_PX, 3), dtype=np.uint8)


def counted(kind: Any, batches: NDArray[Any]) -> dict[str, NDArray[Any]]:
    tracker = kind()
    for batch in batches:
        tracker.update(batch.reshape(-1, batch.shape[-1]))
    found: dict[str, NDArray[Any]] = tracker.get_statistics()
    return found


@pytest.mark.parametrize(
    "images",
    [
        frames(),
        frames(greatest=30),
        frames(least=200),
        np.full((4, EDGE_PX, EDGE_PX, 3), 7, dtype=np.uint8),  # one colour, as of a dark room
        np.concatenate([frames(2, least=100, greatest=110), frames(2)]),  # the range grows on the way
    ],
)
def test_they_are_lerobots(images: NDArray[np.uint8]) -> None:
    expected, found = counted(LEROBOTS, images), counted(ExactStatistics, images)

    assert found.keys() == expected.keys()
    for name in ("min", "max", "count"):
        assert found[name].tolist() == expected[name].tolist()
    for name in ("mean", "std"):  # LeRobot adds up in float32
        assert found[name] == pytest.approx(expected[name], rel=1e-3, abs=1e-3)
    pixels = images.reshape(-1, 3)
    for name, share in SHARES.items():
        exact = np.quantile(pixels, share, axis=0, method="lower")
        assert found[name] == pytest.approx(exact)
        # LeRobot's lie in a bin beside it, and where the range grew, in one that moved.
        assert np.abs(found[name] - expected[name]).max() <= 1


@pytest.mark.parametrize(
    "rows",
    [
        np.random.default_rng(0).normal(size=(3, 20, 8)).astype(np.float32),  # a state
        np.random.default_rng(0).integers(0, 9000, (3, 20, 1)).astype(np.uint16),  # depth
        np.random.default_rng(0).integers(0, 255, (3, 20, 1)).astype(np.uint8),  # grey
    ],
)
def test_those_of_other_rows_are_lerobots_and_numpys(rows: NDArray[Any]) -> None:
    expected, found = counted(LEROBOTS, rows), counted(ExactStatistics, rows)

    assert found.keys() == expected.keys()
    for name in ("min", "max", "mean", "std", "count"):
        assert found[name] == pytest.approx(expected[name], rel=1e-4, abs=1e-5)
    flat = rows.reshape(-1, rows.shape[-1])
    for name, share in SHARES.items():
        assert found[name] == pytest.approx(np.quantile(flat, share, axis=0))


@pytest.mark.parametrize("rows", [np.zeros((1, 3)), np.zeros((1, 3), dtype=np.uint8)])
def test_of_one_row_there_are_none(rows: NDArray[Any]) -> None:
    for kind in (LEROBOTS, ExactStatistics):
        with pytest.raises(ValueError, match="2"):
            counted(kind, rows[None])


def test_a_recording_stores_them(tmp_path: Path) -> None:
    features = {VIDEO: {"dtype": "video", "shape": (EDGE_PX, EDGE_PX, 3), "names": ["height", "width", "c"]}}
    dataset = new_dataset(tmp_path / "one", features, encoder=EncoderSettings(), max_frames=8)
    images = frames(8)
    for image in images:
        dataset.add_frame({VIDEO: image, "task": "look"})
    dataset.save_episode()
    dataset.finalize()

    (file,) = (tmp_path / "one" / "meta" / "episodes").rglob("*.parquet")
    row = pd.read_parquet(file).iloc[0]
    for name, share in SHARES.items():
        stored = [float(channel[0][0]) for channel in row[f"stats/{VIDEO}/{name}"]]
        exact = np.quantile(images.reshape(-1, 3), share, axis=0, method="lower") / 255
        assert stored == pytest.approx(exact)  # LeRobot's are not on a level


def test_an_encoder_takes_the_class_when_it_starts() -> None:
    """Where a new version of LeRobot imports it otherwise, recordings are slower and nothing else."""
    assert "RunningQuantileStats" not in vars(video_utils)
    assert issubclass(ExactStatistics, compute_stats.RunningQuantileStats)
