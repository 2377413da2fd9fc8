"""Write episodes as small LeRobotDatasets that appear whole or not at all, and put them together."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self  # Any: lerobot is untyped

import av
import numpy as np
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.data.checks.rules import MIN_FRAMES
from vla_eval.data.exact_statistics import (
    Histogram,
    count_levels,
    empty_histogram,
    image_statistics,
    vector_statistics,
)
from vla_eval.data.manifest import MIKASA_FOLDER, RecordedEpisode, read_entries, write_lines
from vla_eval.data.opening import join_datasets, video_decoder
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError
from vla_eval.features import CAMERA_KEYS, FPS, EncoderSettings
from vla_eval.robots.rows import PANDA
from vla_eval.storage.drafts import draft_path, publish, remove_drafts

SHARD_EPISODES = MIKASA_FOLDER / "manifest.jsonl"
SHARD_HISTOGRAMS = MIKASA_FOLDER / "histograms.npz"
# One thread, so that the bytes of a video do not depend on the machine's cores.
ENCODER_THREADS = 1


class ShardWriter:
    """Writes one shard to `path`; a context manager that leaves either the whole shard or nothing."""

    def __init__(
        self,
        path: Path,
        features: dict[str, Any],
        *,
        encoder: EncoderSettings,
        max_frames: int,
        robot: str = PANDA.name,
    ) -> None:
        """Take what shards must have in common to become one dataset, see `new_dataset`."""
        self._path = path
        remove_drafts(path)
        self._draft = draft_path(path)
        self._draft.parent.mkdir(parents=True, exist_ok=True)
        self._episodes: list[RecordedEpisode] = []
        self._histograms = {key: empty_histogram() for key in CAMERA_KEYS.values()}
        self._dataset = new_dataset(
            self._draft, features, encoder=encoder, max_frames=max_frames, robot=robot
        )

    def __enter__(self) -> Self:
        return self

    def add_episode(self, episode: RecordedEpisode, frames: Iterable[dict[str, Any]]) -> None:
        """Encode an episode of at least two frames, see `features.frame_values`."""
        if episode.n_steps < MIN_FRAMES:
            raise DatasetError(
                f"{episode.task}, seed {episode.seed}: {episode.n_steps} frames; lerobot needs at least "
                f"{MIN_FRAMES}. Raise steps_after_success."
            )
        for frame in frames:
            for key, histogram in self._histograms.items():
                histogram += count_levels(frame[key])
            self._dataset.add_frame({**frame, "task": episode.instruction})
        self._dataset.save_episode()
        self._episodes.append(episode)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            remove_drafts(self._path)
            return
        self._dataset.finalize()
        (self._draft / MIKASA_FOLDER).mkdir(parents=True, exist_ok=True)
        write_lines(self._draft / SHARD_EPISODES, self._episodes)
        np.savez_compressed(self._draft / SHARD_HISTOGRAMS, **self._histograms)  # type: ignore[arg-type]
        publish(self._draft, self._path)


def new_dataset(
    root: Path,
    features: dict[str, Any],
    *,
    encoder: EncoderSettings,
    max_frames: int,
    robot: str = PANDA.name,
) -> Any:  # Any: lerobot's plain data, and lerobot
    """Return a new LeRobotDataset of these fields to write episodes of up to `max_frames` into."""
    av.logging.set_libav_level(av.logging.ERROR)  # else twenty lines for each video
    return LeRobotDataset.create(
        repo_id=f"local/{root.name}",
        fps=FPS,
        features=features,
        root=root,
        robot_type=robot,
        # Never batch_encoding_size > 1: it fails on a new dataset.
        streaming_encoding=True,
        # A full queue drops frames without an error: give a whole episode room.
        encoder_queue_maxsize=max_frames + 1,
        encoder_threads=ENCODER_THREADS,
        rgb_encoder=RGBEncoderConfig(
            vcodec=encoder.vcodec, pix_fmt=encoder.pix_fmt, crf=encoder.crf, g=encoder.g
        ),
        video_backend=video_decoder(),
    )


def join_shards(shards: Sequence[Path], root: Path) -> tuple[RecordedEpisode, ...]:
    """Put finished shards together as one new LeRobotDataset with exact statistics; return its episodes."""
    join_datasets(shards, root)
    histograms = {key: empty_histogram() for key in CAMERA_KEYS.values()}
    for shard in shards:
        with np.load(shard / SHARD_HISTOGRAMS) as stored:
            for key, histogram in histograms.items():
                histogram += stored[key]
    write_exact_statistics(root, histograms)
    return tuple(episode for shard in shards for episode in shard_episodes(shard))


def write_exact_statistics(root: Path, histograms: dict[str, Histogram]) -> None:
    """Replace `meta/stats.json` by statistics over all rows and all pixels."""
    columns = read_columns(root)
    n_frames = len(columns["index"])
    statistics = {key: vector_statistics(rows.reshape(n_frames, -1)) for key, rows in columns.items()}
    images = {key: image_statistics(found, n_frames=n_frames) for key, found in histograms.items()}
    write_stats({**statistics, **images}, root)


def shard_episodes(shard: Path) -> tuple[RecordedEpisode, ...]:
    """Return the episodes of a finished shard."""
    return read_entries(shard / SHARD_EPISODES, RecordedEpisode)
