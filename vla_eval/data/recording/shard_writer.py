"""Write episodes as small LeRobotDatasets that appear whole or not at all, and put them together."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self  # Any: lerobot is untyped

import av
import numpy as np
from datasets.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars
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
from vla_eval.data.manifest import MIKASA_FOLDER, ArmEpisode, RecordedEpisode, read_entries, write_lines
from vla_eval.data.opening import join_datasets, video_decoder
from vla_eval.data.recording.episode_statistics import use_exact_statistics
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError
from vla_eval.features import FPS, EncoderSettings
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
        fps: int = FPS,
    ) -> None:
        """Take what shards must have in common to become one dataset, see `new_dataset`."""
        self._path = path
        remove_drafts(path)
        self._draft = draft_path(path)
        self._draft.parent.mkdir(parents=True, exist_ok=True)
        self._episodes: list[RecordedEpisode | ArmEpisode] = []
        self._histograms = {key: empty_histogram() for key in videos_of(features)}
        self._is_discarded = False
        self._dataset = new_dataset(
            self._draft, features, encoder=encoder, max_frames=max_frames, robot=robot, fps=fps
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
            self.add_frame(frame, episode.instruction)
        self.save(episode)

    def add_frame(self, frame: dict[str, Any], instruction: str) -> None:
        """Encode a frame of an episode that `save` ends."""
        for key, histogram in self._histograms.items():
            histogram += count_levels(frame[key])
        self._dataset.add_frame({**frame, "task": instruction})

    def save(self, episode: RecordedEpisode | ArmEpisode) -> None:
        """End an episode whose frames have been added."""
        with _no_bars():
            self._dataset.save_episode()
        self._episodes.append(episode)

    def discard(self) -> None:
        """Leave nothing behind at the end."""
        self._is_discarded = True

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None or self._is_discarded:
            self._dataset.clear_episode_buffer()  # ends the threads that encode
            remove_drafts(self._path)
            return
        self._dataset.finalize()
        (self._draft / MIKASA_FOLDER).mkdir(parents=True, exist_ok=True)
        write_lines(self._draft / SHARD_EPISODES, self._episodes)
        np.savez_compressed(self._draft / SHARD_HISTOGRAMS, **self._histograms)  # type: ignore[arg-type]
        publish(self._draft, self._path)


@contextlib.contextmanager
def _no_bars() -> Iterator[None]:
    """Let `datasets` show no bar for an episode that is written in a moment: an operator reads here."""
    were_shown = not are_progress_bars_disabled()
    disable_progress_bars()
    try:
        yield
    finally:
        if were_shown:
            enable_progress_bars()


def new_dataset(
    root: Path,
    features: dict[str, Any],
    *,
    encoder: EncoderSettings,
    max_frames: int,
    robot: str = PANDA.name,
    fps: int = FPS,
) -> Any:  # Any: lerobot's plain data, and lerobot
    """Return a new LeRobotDataset of these fields to write episodes of up to `max_frames` into."""
    av.logging.set_libav_level(av.logging.ERROR)  # else twenty lines for each video
    use_exact_statistics()
    return LeRobotDataset.create(
        repo_id=f"local/{root.name}",
        fps=fps,
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


def videos_of(features: Mapping[str, Any]) -> list[str]:
    """Return the fields that are videos."""
    return [key for key, feature in features.items() if feature["dtype"] == "video"]


def join_shards[E: RecordedEpisode | ArmEpisode](
    shards: Sequence[Path], root: Path, cls: type[E]
) -> tuple[E, ...]:
    """Put finished shards together as one new LeRobotDataset with exact statistics; return its episodes."""
    join_datasets(shards, root)
    histograms: dict[str, Histogram] = {}
    for shard in shards:
        with np.load(shard / SHARD_HISTOGRAMS) as stored:
            for key in stored:
                histograms[key] = histograms.get(key, empty_histogram()) + stored[key]
    write_exact_statistics(root, histograms)
    return tuple(episode for shard in shards for episode in read_entries(shard / SHARD_EPISODES, cls))


def write_exact_statistics(root: Path, histograms: dict[str, Histogram]) -> None:
    """Replace `meta/stats.json` by statistics over all rows and all pixels."""
    columns = read_columns(root)
    n_frames = len(columns["index"])
    statistics = {key: vector_statistics(rows.reshape(n_frames, -1)) for key, rows in columns.items()}
    images = {key: image_statistics(found, n_frames=n_frames) for key, found in histograms.items()}
    write_stats({**statistics, **images}, root)
