"""Write foreign demonstrations as a LeRobotDataset under our names: what the source has, and no more."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval import __version__
from vla_eval.config.prompts import DEFAULT_PROMPT_SET
from vla_eval.control_modes import EE_DELTA_POSE
from vla_eval.core import FloatArray
from vla_eval.data.checks.demonstrated import Numbers
from vla_eval.data.dataset_folder import digest_file, digest_files
from vla_eval.data.exact_statistics import count_levels, empty_histogram
from vla_eval.data.facts import ImportedEpisode, ImportFacts
from vla_eval.data.foreign.episodes import (
    EEF_KEY,
    JOINTS_KEY,
    NUMBER_NAMES,
    PER_STEP,
    SOURCE_PROPRIO_KEY,
    Source,
    SourceEpisode,
)
from vla_eval.data.manifest import IMPORT_FILE, write_entry
from vla_eval.data.recording.shard_writer import new_dataset, write_exact_statistics
from vla_eval.errors import DatasetError
from vla_eval.features import (
    ACTION_KEY,
    CAMERA_KEYS,
    PROPRIO_KEYS,
    STATE_KEY,
    SUCCESS_KEY,
    EncoderSettings,
    StateKind,
    dataset_features,
    proprioception,
)
from vla_eval.tasks.spec import TaskSpec

MAX_FRAMES = 2048  # lerobot drops frames without an error where its queue is full: room for a whole episode


class ImportWriter:
    """Writes episodes of one source, whose numbers have the types of our fields, as a dataset at `draft`."""

    def __init__(self, draft: Path, source: Source, *, task: TaskSpec | None, state: StateKind) -> None:
        self._draft, self._source, self._state, self._task = draft, source, state, task
        self._episodes: list[ImportedEpisode] = []
        self._histograms = {camera: empty_histogram() for camera in CAMERA_KEYS.values()}
        for episode in source.episodes:
            if episode.n_frames > MAX_FRAMES:
                raise DatasetError(
                    f"{source.path}: {episode.name} has {episode.n_frames} frames, expected at most "
                    f"{MAX_FRAMES}."
                )
        columns = _columns(source.episodes[0], state, where=source.path)
        size_px = source.episodes[0].image_sizes_px[0][0]
        self._features = _features({*columns, *CAMERA_KEYS.values()}, source, state, size_px)
        self._dataset = new_dataset(draft, self._features, encoder=EncoderSettings(), max_frames=MAX_FRAMES)

    def add(self, episode: SourceEpisode) -> None:
        """Encode an episode."""
        columns = _columns(episode, self._state, where=self._source.path)
        images = dict(zip(CAMERA_KEYS.values(), episode.read_images(), strict=True))
        for camera, frames in images.items():
            self._histograms[camera] += count_levels(frames)
        for step in range(episode.n_frames):
            frame = {key: values[step] for key, values in (*columns.items(), *images.items())}
            self._dataset.add_frame({**frame, "task": episode.sentences[step]})
        self._dataset.save_episode()
        success = episode.numbers.get(SUCCESS_KEY)
        self._episodes.append(
            ImportedEpisode(
                name=episode.name,
                n_steps=episode.n_frames,
                instruction=str(episode.sentences[0]),
                source_seed=episode.seed,
                success=None if success is None else bool(success.any()),
            )
        )

    def finish(self, *, converted: tuple[str, ...], kept: tuple[str, ...]) -> ImportFacts:
        """Close the dataset and write what it is; for the arguments see `ImportFacts`."""
        self._dataset.finalize()
        write_exact_statistics(self._draft, self._histograms)
        mode, root = self._source.action.control_mode, self._source.path
        from_prompts = any(one.startswith("instruction: ") for one in converted)
        facts = ImportFacts(
            complete=True,
            source_layout=self._source.layout,
            task=None if self._task is None else self._task.id,
            instruction_source=f"prompts/{DEFAULT_PROMPT_SET}" if from_prompts else "source",
            state=self._state,
            control_mode=mode,
            executable_by_pd_ee_delta_pose=mode == EE_DELTA_POSE,
            absent=tuple(key for key in dataset_features(self._state) if key not in self._features),
            left_out=self._source.left_out,
            n_frames=sum(episode.n_steps for episode in self._episodes),
            episodes=tuple(self._episodes),
            source_files={
                path.relative_to(root).as_posix(): digest_file(path) for path in self._source.files
            },
            files=digest_files(self._draft),
            vla_eval_version=__version__,
            is_checked=True,
            converted=converted,
            kept=kept,
        )
        write_entry(self._draft / IMPORT_FILE, facts)
        return facts


def eef_of_proprio(proprio: FloatArray) -> FloatArray:
    """Return our end-effector state (10,) of the authors' (7,), with angles of Rz(yaw) Ry(pitch) Rx(roll)."""
    cos, sin = np.cos(proprio[3:6].astype(np.float64)), np.sin(proprio[3:6].astype(np.float64))
    (cr, cp, cy), (sr, sp, sy) = cos, sin
    first = (cy * cp, sy * cp, -sp)
    second = (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    return np.array([*proprio[:3], *first, *second, proprio[6]], dtype=np.float32)


def _columns(episode: SourceEpisode, state: StateKind, *, where: Path) -> dict[str, Numbers]:
    """Return field -> (T, …) of all numbers that the episode has, under our names."""
    numbers: Mapping[str, Any] = episode.numbers  # Any: of several types
    kinds: dict[StateKind, FloatArray] = {}
    if JOINTS_KEY in numbers:
        kinds["joints"] = numbers[JOINTS_KEY]
    if EEF_KEY in numbers:
        kinds["eef"] = numbers[EEF_KEY]
    elif JOINTS_KEY in numbers:
        rows = [
            proprioception({"tcp_pose": row[:7], "qpos": row[7:16], "qvel": row[16:]})
            for row in numbers[JOINTS_KEY]
        ]
        kinds["eef"] = np.stack([row["eef"] for row in rows])
    else:
        kinds["eef"] = np.stack([eef_of_proprio(row) for row in numbers[SOURCE_PROPRIO_KEY]])
    if state not in kinds:
        raise DatasetError(
            f"{where}: {episode.name} has no joint velocities, so observation.state cannot be '{state}'; "
            f"nothing is made up. It has: {', '.join(kinds)}."
        )
    columns: dict[str, Numbers] = {
        STATE_KEY: kinds[state],
        ACTION_KEY: numbers[ACTION_KEY],
        **{PROPRIO_KEYS[kind]: values for kind, values in kinds.items()},
    }
    if SOURCE_PROPRIO_KEY in numbers:
        columns[SOURCE_PROPRIO_KEY] = numbers[SOURCE_PROPRIO_KEY]
    return columns | {key: numbers[key][:, None] for key in PER_STEP if key in numbers}


def _features(fields: set[str], source: Source, state: StateKind, image_size_px: int) -> dict[str, Any]:
    known = dataset_features(state, action_names=source.action.dims, image_size_px=image_size_px)
    features = {key: value for key, value in known.items() if key in fields}
    if SOURCE_PROPRIO_KEY in fields:
        names = list(NUMBER_NAMES[SOURCE_PROPRIO_KEY])
        features[SOURCE_PROPRIO_KEY] = {"dtype": "float32", "shape": (len(names),), "names": names}
    return features
