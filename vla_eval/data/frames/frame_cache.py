"""Decoded frames in files to be mapped, found by digest: `<camera>.npy` (N, 3, H, W) uint8."""

import contextlib
import errno
import fcntl
import hashlib
import importlib.metadata
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
from lerobot.datasets.video_utils import decode_video_frames

from vla_eval.core import ImageArray
from vla_eval.data.opening import UNREADABLE, reason
from vla_eval.data.tables import MIB
from vla_eval.errors import DatasetError, StorageFullError
from vla_eval.storage.cache import cached
from vla_eval.workers.start import available_ram_bytes

FORMAT_VERSION = 1  # raised when the files' layout changes: old ones are then not found any more
FRAMES_FOLDER = "frames"  # in the user's cache
DIGEST_DIGITS = 24
# Beyond the frames: file headers, and what a file system keeps for itself.
HEADROOM_BYTES = 16 * MIB
_MORE_ROOM = "free some space, let XDG_CACHE_HOME name another disk, or select fewer episodes"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRows:
    """One episode's frames: rows [first, stop) of the loaded dataset, and seconds since its beginning."""

    index: int
    first: int
    stop: int
    timestamps_s: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSource:
    """What has to be decoded: the videos of a loaded `LeRobotDataset`, and the episodes that are selected."""

    dataset: Any  # LeRobotDataset: untyped
    shapes: Mapping[str, tuple[int, int, int]]
    episodes: Sequence[EpisodeRows]

    @property
    def n_frames(self) -> int:
        """How many rows there are."""
        return self.episodes[-1].stop if self.episodes else 0

    @property
    def n_bytes(self) -> int:
        """How much the decoded frames take."""
        return self.n_frames * sum(int(np.prod(shape)) for shape in self.shapes.values())


def episode_rows(dataset: Any, columns: Mapping[str, Any]) -> list[EpisodeRows]:
    """Return where the episodes of a loaded `LeRobotDataset` are, by the columns of its rows."""
    indices, numbers, times_s = (columns[key].tolist() for key in ("index", "episode_index", "timestamp"))
    episodes = []
    row = 0
    while row < len(indices):
        ends = dataset.meta.episodes[numbers[row]]
        expected = list(range(ends["dataset_from_index"], ends["dataset_to_index"]))
        stop = row + len(expected)
        if indices[row:stop] != expected:
            raise DatasetError(
                f"{dataset.root}: the frames of episode {numbers[row]} are not numbered {expected[0]} to "
                f"{expected[-1]} in a row. The files in data/ and meta/episodes/ are not of one dataset."
            )
        episodes.append(
            EpisodeRows(index=numbers[row], first=row, stop=stop, timestamps_s=tuple(times_s[row:stop]))
        )
        row = stop
    return episodes


def frame_source(dataset: Any, columns: Mapping[str, Any]) -> FrameSource:
    """Return what has to be decoded of a loaded dataset; see `episode_rows`."""
    shapes = {key: channels_first(dataset.meta.features[key]) for key in dataset.meta.video_keys}
    return FrameSource(dataset=dataset, shapes=shapes, episodes=episode_rows(dataset, columns))


def dataset_digest(source: FrameSource) -> str:
    """Return a digest of all that the decoded frames depend on: files, selection, decoder."""
    root = Path(source.dataset.root)
    digest = hashlib.sha256(f"frames {FORMAT_VERSION}\n".encode())
    backend = source.dataset._video_backend
    package = {"pyav": "av"}.get(backend, backend)
    digest.update(f"{backend} {importlib.metadata.version(package)}\n".encode())
    digest.update(f"lerobot {importlib.metadata.version('lerobot')}\n".encode())
    digest.update(f"{[episode.index for episode in source.episodes]}\n".encode())
    for path in _files(source, root):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:DIGEST_DIGITS]


def channels_first(feature: Mapping[str, Any]) -> tuple[int, int, int]:
    """Return (channels, height, width) of an RGB camera, in whichever order they are described."""
    # lerobot's own datasets call the last one `channel` as well as `channels`.
    names = [{"channel": "channels"}.get(str(name), name) for name in feature.get("names") or ()]
    shape = tuple(feature["shape"])
    if not names and len(shape) == 3 and (shape[0] == 3) != (shape[2] == 3):
        names = ["channels", "height", "width"] if shape[0] == 3 else ["height", "width", "channels"]
    sizes = dict(zip(names, shape, strict=False))
    if (
        sorted(map(str, sizes)) != ["channels", "height", "width"]
        or len(shape) != 3
        or sizes["channels"] != 3
    ):
        raise DatasetError(
            f"a camera is described by {dict(feature)!s:.300}: expected height, width and 3 channels."
        )
    return 3, int(sizes["height"]), int(sizes["width"])


def decode_camera(source: FrameSource, camera: str) -> Iterator[ImageArray]:
    """Yield the (T, 3, H, W) uint8 frames of each episode in turn; `DatasetError` where a video lacks one."""
    dataset = source.dataset
    for episode in source.episodes:
        row = dataset.meta.episodes[episode.index]
        path = Path(dataset.root) / dataset.meta.get_video_file_path(episode.index, camera)
        begin_s = row[f"videos/{camera}/from_timestamp"]
        times_s = [begin_s + timestamp for timestamp in episode.timestamps_s]
        try:
            frames = decode_video_frames(
                path, times_s, dataset.tolerance_s, dataset._video_backend, return_uint8=True
            )
        except UNREADABLE as exc:
            raise DatasetError(
                f"{path}: episode {episode.index} of camera '{camera}' cannot be decoded "
                f"({reason(exc)}). The video is damaged or belongs to another dataset."
            ) from exc
        shape = (episode.stop - episode.first, *source.shapes[camera])
        if tuple(frames.shape) != shape:
            raise DatasetError(
                f"{path}: episode {episode.index} has frames {tuple(frames.shape)}, not {shape}."
            )
        decoded: ImageArray = frames.numpy()
        yield decoded


def frames_in_ram(source: FrameSource) -> dict[str, ImageArray]:
    """Decode all frames into this process's RAM, or raise `DatasetError`."""
    free = available_ram_bytes()
    if source.n_bytes + HEADROOM_BYTES > free:
        raise DatasetError(
            f"{_decoded_size(source)}, but {free / MIB:.0f} MiB of RAM are free. "
            f"Use storage='disk' (a memory map), or select fewer episodes."
        )
    return {camera: np.concatenate(list(decode_camera(source, camera))) for camera in source.shapes}


def frames_on_disk(source: FrameSource, cache: Path | None) -> dict[str, Path]:
    """Return camera -> `.npy` file of its frames, decoding them if the folder has none yet."""
    name = f"{FRAMES_FOLDER}/{dataset_digest(source)}"
    final = cached(name) if cache is None else cache / name
    paths = {camera: final / f"{camera}.npy" for camera in source.shapes}
    if final.is_dir():
        return paths
    final.parent.mkdir(parents=True, exist_ok=True)
    with _one_builder(final.with_name(f"{final.name}.lock")):
        if not final.is_dir():
            _build(source, final)
    return paths


def _files(source: FrameSource, root: Path) -> list[Path]:
    """Return the files that say which frames there are, and the videos, in a fixed order."""
    meta = source.dataset.meta
    videos = {
        root / meta.get_video_file_path(episode.index, camera)
        for camera in source.shapes
        for episode in source.episodes
    }
    tables = [*root.glob("meta/episodes/**/*.parquet"), *root.glob("data/**/*.parquet")]
    return [root / "meta/info.json", *sorted(tables), *sorted(videos)]


def _build(source: FrameSource, final: Path) -> None:
    free = shutil.disk_usage(final.parent).free
    if source.n_bytes + HEADROOM_BYTES > free:
        raise DatasetError(
            f"{_decoded_size(source)}, but {free / MIB:.0f} MiB are free at {final.parent}: {_MORE_ROOM}."
        )
    # The process that made these was killed: we have the lock.
    for stale in final.parent.glob(f"{final.name}.*.tmp"):
        shutil.rmtree(stale, ignore_errors=True)
    draft = final.with_name(f"{final.name}.{os.getpid()}.tmp")
    draft.mkdir()
    try:
        for camera, shape in source.shapes.items():
            _write_camera(source, camera, draft / f"{camera}.npy", (source.n_frames, *shape))
        draft.rename(final)
    except OSError as exc:
        # Where files cannot be locked another process may have been faster; its frames are the same.
        if not final.is_dir():
            if exc.errno in (errno.ENOSPC, errno.EDQUOT):
                raise StorageFullError(
                    f"{final.parent}: the disk became full on the way. {_decoded_size(source)}; {_MORE_ROOM}."
                ) from exc
            raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    logger.info("decoded %d frames into %s", source.n_frames, final)


def _write_camera(source: FrameSource, camera: str, path: Path, shape: tuple[int, ...]) -> None:
    # Written, not mapped: a full disk is then an error that can be caught instead of a SIGBUS.
    with open(path, "wb") as file:
        header = {"descr": "|u1", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)  # type: ignore[no-untyped-call]  # numpy 2.2
        for frames in decode_camera(source, camera):
            file.write(np.ascontiguousarray(frames).data)


@contextlib.contextmanager
def _one_builder(path: Path) -> Iterator[None]:
    """Wait until no other process is in here; a file system without locks lets everybody in."""
    with open(path, "w", encoding="ascii") as file:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _decoded_size(source: FrameSource) -> str:
    size = f"{source.n_bytes / MIB:.0f} MiB"
    return f"{source.n_frames} frames of {len(source.shapes)} cameras take {size} decoded"
