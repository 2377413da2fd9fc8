"""Write foreign demonstrations as a LeRobotDataset under our names: what the source has, and no more."""

from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval import __version__
from vla_eval.config.prompts import DEFAULT_PROMPT_SET, instruction_for
from vla_eval.control_modes import EE_DELTA_POSE, action_spec
from vla_eval.core import FloatArray
from vla_eval.data.dataset_folder import digest_file, digest_files
from vla_eval.data.exact_statistics import count_levels, empty_histogram
from vla_eval.data.imported import ImportedEpisode, ImportFacts, write_import
from vla_eval.data.layouts import SOURCE_MODES, Source, SourceEpisode
from vla_eval.data.shard_writer import MIN_FRAMES, new_dataset, write_exact_statistics
from vla_eval.errors import DatasetError
from vla_eval.features import (
    ACTION_KEY,
    CAMERA_KEYS,
    DONE_KEY,
    PROPRIO_KEYS,
    REWARD_KEY,
    STATE_KEY,
    SUCCESS_KEY,
    EncoderSettings,
    StateKind,
    dataset_features,
    proprioception,
)
from vla_eval.tasks.catalog import task_spec

SOURCE_PROPRIO_KEY = "proprio.xyz_rpy"
SOURCE_PROPRIO_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper_width")
MAX_FRAMES = 2048  # lerobot drops frames without an error where its queue is full: room for a whole episode


class ImportWriter:
    """Writes episodes of one source; all must have the same fields.

    Args:
        draft: the folder to make.
        source: where the episodes are from, for messages and the record.
        task: task id; gives the instruction where the source has none.
        state: which proprioception `observation.state` is.
    """

    def __init__(self, draft: Path, source: Source, *, task: str | None, state: StateKind) -> None:
        self._draft, self._source, self._state = draft, source, state
        self._task = None if task is None else task_spec(task)
        self._dataset: Any = None
        self._features: dict[str, Any] = {}
        self._episodes: list[ImportedEpisode] = []
        self._histograms = {camera: empty_histogram() for camera in CAMERA_KEYS.values()}
        self._uses_prompts = False

    def add(self, episode: SourceEpisode) -> None:
        """Encode an episode."""
        columns = _columns(episode, self._state, where=self._source.path)
        features = _features(columns, self._state)
        if self._dataset is None:
            self._features = features
            self._dataset = new_dataset(
                self._draft, features, encoder=EncoderSettings(), max_frames=MAX_FRAMES
            )
        elif features != self._features:
            differing = sorted(set(features) ^ set(self._features)) or [ACTION_KEY]
            raise DatasetError(
                f"{self._source.path}: {episode.name} differs from the episodes before it in "
                f"{', '.join(differing)}; one dataset has the same fields everywhere. Convert them apart."
            )
        if not MIN_FRAMES <= episode.n_frames <= MAX_FRAMES:
            raise DatasetError(
                f"{self._source.path}: {episode.name} has {episode.n_frames} frames, expected "
                f"{MIN_FRAMES} to {MAX_FRAMES}."
            )
        instruction = self._instruction(episode)
        for step in range(episode.n_frames):
            frame = {key: values[step] for key, values in columns.items()}
            for camera, histogram in self._histograms.items():
                histogram += count_levels(frame[camera])
            self._dataset.add_frame({**frame, "task": instruction})
        self._dataset.save_episode()
        success = None if episode.success_T is None else bool(episode.success_T.any())
        self._episodes.append(
            ImportedEpisode(
                name=episode.name,
                n_steps=episode.n_frames,
                instruction=instruction,
                source_seed=episode.seed,
                success=success,
            )
        )

    def finish(self) -> ImportFacts:
        """Close the dataset and write what it is."""
        self._dataset.finalize()
        write_exact_statistics(self._draft, self._histograms)
        control_mode = SOURCE_MODES[self._features[ACTION_KEY]["shape"][0]]
        root = self._source.path
        facts = ImportFacts(
            complete=True,
            source_layout=self._source.layout,
            task=None if self._task is None else self._task.id,
            instruction_source=f"prompts/{DEFAULT_PROMPT_SET}" if self._uses_prompts else "source",
            state=self._state,
            control_mode=control_mode,
            executable_by_pd_ee_delta_pose=control_mode == EE_DELTA_POSE,
            absent=tuple(key for key in dataset_features(self._state) if key not in self._features),
            left_out=tuple(sorted(self._source.left_out)),
            n_frames=sum(episode.n_steps for episode in self._episodes),
            episodes=tuple(self._episodes),
            source_files={
                path.relative_to(root).as_posix(): digest_file(path) for path in self._source.files
            },
            files=digest_files(self._draft),
            vla_eval_version=__version__,
        )
        write_import(self._draft, facts)
        return facts

    def _instruction(self, episode: SourceEpisode) -> str:
        if episode.instruction is not None:
            return episode.instruction
        if self._task is None:
            raise DatasetError(
                f"{self._source.path}: {episode.name} has no language instruction. Name the task, whose "
                f"sentence is then used: --task RememberColor3-v0."
            )
        self._uses_prompts = True
        return instruction_for(self._task)


def eef_of_proprio(proprio: FloatArray) -> FloatArray:
    """Return our end-effector state (10,) of the authors' (7,): see `features.STATE_NAMES`.

    The angles are those of Rz(yaw) Ry(pitch) Rx(roll), the inverse of how their wrapper computes them.
    """
    cos, sin = np.cos(proprio[3:6].astype(np.float64)), np.sin(proprio[3:6].astype(np.float64))
    (cr, cp, cy), (sr, sp, sy) = cos, sin
    first = (cy * cp, sy * cp, -sp)
    second = (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    return np.array([*proprio[:3], *first, *second, proprio[6]], dtype=np.float32)


def _columns(episode: SourceEpisode, state: StateKind, *, where: Path) -> dict[str, Any]:
    """Return field -> (T, …) of all that the episode has, under our names."""
    kinds: dict[StateKind, FloatArray] = {}
    if episode.joints_TD is not None:
        rows = [
            proprioception({"tcp_pose": row[:7], "qpos": row[7:16], "qvel": row[16:]})
            for row in episode.joints_TD
        ]
        kinds = {"eef": np.stack([row["eef"] for row in rows]), "joints": episode.joints_TD}
    elif episode.proprio_TD is not None:
        kinds = {"eef": np.stack([eef_of_proprio(row) for row in episode.proprio_TD])}
    if state not in kinds:
        raise DatasetError(
            f"{where}: {episode.name} has no joint velocities, so observation.state cannot be '{state}'; "
            f"nothing is made up. It has: {', '.join(kinds)}."
        )
    base, wrist = CAMERA_KEYS.values()
    columns: dict[str, Any] = {
        base: episode.images_base_THWC,
        wrist: episode.images_wrist_THWC,
        STATE_KEY: kinds[state],
        ACTION_KEY: episode.actions_TA,
        **{PROPRIO_KEYS[kind]: values for kind, values in kinds.items()},
    }
    if episode.proprio_TD is not None:
        columns[SOURCE_PROPRIO_KEY] = episode.proprio_TD
    per_frame = {
        REWARD_KEY: episode.rewards_T,
        SUCCESS_KEY: episode.success_T,
        DONE_KEY: episode.done_T,
    }
    columns |= {key: values[:, None] for key, values in per_frame.items() if values is not None}
    return columns


def _features(columns: dict[str, Any], state: StateKind) -> dict[str, Any]:
    action = action_spec(SOURCE_MODES[columns[ACTION_KEY].shape[1]])
    known = dataset_features(state, action_names=action.dims)
    features = {key: value for key, value in known.items() if key in columns}
    if SOURCE_PROPRIO_KEY in columns:
        names = list(SOURCE_PROPRIO_NAMES)
        features[SOURCE_PROPRIO_KEY] = {"dtype": "float32", "shape": (len(names),), "names": names}
    return features
