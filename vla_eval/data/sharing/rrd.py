"""Write an episode of a dataset as an `.rrd` for the rerun viewer; entities: docs/captures.md."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from vla_eval.data.manifest import MANIFEST_FILE, RecordedEpisode, read_manifest
from vla_eval.data.opening import open_local_dataset, read_sample
from vla_eval.errors import ViewingError
from vla_eval.features import (
    ACTION_KEY,
    POSE_NAMES,
    PROPRIO_KEYS,
    REWARD_KEY,
    STATE_KEY,
    STATE_NAMES,
    SUCCESS_KEY,
)
from vla_eval.models.shared.images import in_bytes
from vla_eval.task_state import PHASES
from vla_eval.viz.rerun_file import layout, rrd_when_whole, send_curve, set_step, time_columns
from vla_eval.viz.rerun_log import COLORS, JPEG_QUALITY, log_arm

PLACE_NAMES = ("x", "y", "z")
PATH_FIELDS = (PROPRIO_KEYS["eef"], STATE_KEY)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeWish:
    """Which episodes of a dataset: by number, by seed, or else the first `most`."""

    episodes: tuple[int, ...] = ()
    seed: int | None = None
    most: int = 5


def write_dataset_rrds(root: Path, wish: EpisodeWish, folder: Path) -> list[Path]:
    """Write the wished episodes as `episode_000003.rrd`, replacing files of that name; return their paths."""
    dataset = open_local_dataset(root)
    recorded = read_manifest(root) if (root / MANIFEST_FILE).is_file() else ()
    numbers = _wished(root, wish, int(dataset.meta.total_episodes), recorded)
    return [
        _write(dataset, number, recorded[number] if recorded else None, folder / f"episode_{number:06d}.rrd")
        for number in numbers
    ]


def _wished(
    root: Path, wish: EpisodeWish, n_episodes: int, recorded: Sequence[RecordedEpisode]
) -> Sequence[int]:
    if wish.seed is not None:
        found = [one.episode_index for one in recorded if one.seed == wish.seed]
        if not found:
            shown = [str(one.seed) for one in recorded[:5]] + ["…"] * (len(recorded) > 5)
            known = f"Its seeds: {', '.join(shown)}." if shown else "It names none."
            raise ViewingError(f"{root}: no episode of seed {wish.seed}. {known}")
        return found
    for number in wish.episodes:
        if not 0 <= number < n_episodes:
            raise ViewingError(f"{root}: there is no episode {number}; they are 0 to {n_episodes - 1}.")
    return wish.episodes or range(min(wish.most, n_episodes))


def _write(dataset: Any, number: int, recorded: RecordedEpisode | None, path: Path) -> Path:
    row = dataset.meta.episodes[number]
    frames = [
        read_sample(dataset, index) for index in range(row["dataset_from_index"], row["dataset_to_index"])
    ]
    cameras = [_camera(key) for key in dataset.meta.camera_keys]
    with rrd_when_whole(
        path,
        recording_id=f"{dataset.root.name}_{number}",
        blueprint=layout(cameras, _dims(dataset, ACTION_KEY), _dims(dataset, STATE_KEY)),
        failed="cannot be written",
        advice="Free some space.",
    ) as stream:
        _log_facts(stream, dataset, number, frames, recorded)
        _log_numbers(stream, dataset, frames)
        _log_arm(stream, dataset, frames)
        for step, frame in enumerate(frames):
            set_step(stream, step, float(dataset.fps))
            for key in dataset.meta.camera_keys:
                picture = in_bytes(frame[key]).permute(1, 2, 0).numpy()
                stream.log(f"cameras/{_camera(key)}", rr.Image(picture).compress(jpeg_quality=JPEG_QUALITY))
        if recorded is not None:
            _log_phases(stream, recorded, float(dataset.fps))
    return path


def _camera(key: str) -> str:
    return key.rpartition(".")[2]


def _dims(dataset: Any, key: str) -> tuple[str, ...]:
    """Return the names of a vector's dimensions; their numbers where the dataset names none."""
    if key not in dataset.features:
        return ()
    feature = dataset.features[key]
    names = feature.get("names")
    n_dims = int(feature["shape"][-1])
    named = isinstance(names, list) and len(names) == n_dims
    return tuple(map(str, names)) if named else tuple(map(str, range(n_dims)))


def _column(frames: Sequence[Mapping[str, Any]], key: str) -> NDArray[np.float64]:
    return np.stack([np.asarray(frame[key], dtype=np.float64).reshape(-1) for frame in frames])


def _log_facts(
    stream: rr.RecordingStream,
    dataset: Any,
    number: int,
    frames: Sequence[Mapping[str, Any]],
    recorded: RecordedEpisode | None,
) -> None:
    lines = [f"# {frames[0]['task']}", f"{dataset.root.name}, episode {number}, {len(frames)} frames"]
    if recorded is not None:
        success = "never" if recorded.success_step is None else f"at step {recorded.success_step}"
        lines.append(f"{recorded.task}, {recorded.expert}, seed {recorded.seed}; success {success}")
    text = rr.TextDocument("\n\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    stream.log("instruction", text, static=True)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)


def _log_numbers(stream: rr.RecordingStream, dataset: Any, frames: Sequence[Mapping[str, Any]]) -> None:
    columns: dict[str, NDArray[np.float64]] = {}
    for key, entity in ((ACTION_KEY, "actions/{}/stored"), (STATE_KEY, "state/{}")):
        names = _dims(dataset, key)
        if names:
            columns |= {
                entity.format(name): values
                for name, values in zip(names, _column(frames, key).T, strict=True)
            }
    for key, entity in ((REWARD_KEY, "reward"), (SUCCESS_KEY, "success")):
        if key in dataset.features:
            columns[entity] = _column(frames, key)[:, 0]
    steps, fps = np.arange(len(frames)), float(dataset.fps)
    for entity, values in columns.items():
        send_curve(stream, entity, steps, values, fps)
    for key in PATH_FIELDS:
        if _dims(dataset, key)[:3] == PLACE_NAMES:
            way = _column(frames, key)[:, :3]
            strip = rr.LineStrips3D([way], colors=[COLORS["tcp"]], radii=0.002)
            stream.log("world/tcp_path", strip, static=True)
            places = rr.Points3D.columns(positions=way, radii=np.full(len(way), 0.012))
            stream.send_columns("world/tcp", indexes=time_columns(steps, fps), columns=places)
            return


def _log_arm(stream: rr.RecordingStream, dataset: Any, frames: Sequence[Mapping[str, Any]]) -> None:
    key = PROPRIO_KEYS["joints"]
    if _dims(dataset, key) != STATE_NAMES["joints"]:
        return
    for step, numbers in enumerate(_column(frames, key)):
        set_step(stream, step, float(dataset.fps))
        log_arm(stream, numbers[len(POSE_NAMES) :], numbers[:3])


def _log_phases(stream: rr.RecordingStream, recorded: RecordedEpisode, fps: float) -> None:
    """Log the phase of each frame; a frame is what was seen before its action."""
    begins = np.cumsum([0, recorded.cue_steps, recorded.delay_steps])
    ends = [*begins[1:], recorded.n_steps]
    steps = np.arange(recorded.n_steps)
    for phase, begin, end in zip(PHASES, begins, ends, strict=True):
        values = ((steps >= begin) & (steps < end)).astype(np.float64)
        send_curve(stream, f"phase/{phase}", steps, values, fps)
    events = [(int(step), f"phase {phase}") for phase, step in zip(PHASES, begins, strict=True)]
    if recorded.success_step is not None:
        events.append((recorded.success_step, "success"))
    for step, text in events:
        set_step(stream, step, fps)
        stream.log("events", rr.TextLog(text))
