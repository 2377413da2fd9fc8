"""Read from a dataset what its card says: lengths, success, actions, a few images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval.core import FloatArray
from vla_eval.data.exact_statistics import RESOLUTION
from vla_eval.data.frames.frame_cache import decode_camera, frame_source
from vla_eval.data.opening import OpenDataset
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, SUCCESS_KEY
from vla_eval.viz.contact_sheet import SheetRow, contact_sheet

N_SHEET_EPISODES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionStatistics:
    """Over all frames, one number per dimension of the action."""

    names: tuple[str, ...]
    mean: FloatArray
    std: FloatArray
    low: FloatArray
    high: FloatArray

    @property
    def idle(self) -> tuple[str, ...]:
        """The dimensions that hardly vary, which a normalisation by the standard deviation blows up."""
        return tuple(name for name, std in zip(self.names, self.std, strict=True) if std < RESOLUTION)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSummary:
    """What a card is written from.

    Attributes:
        dataset: what it summarises.
        lengths: (E,) frames per episode.
        n_success: episodes in which the success rule held at some frame; None if that is not stored.
        instructions: every sentence that occurs.
        fields: field -> `float32 (7)`.
        action: over all frames.
        image_size_px: height and width of the images.
    """

    dataset: OpenDataset
    lengths: tuple[int, ...]
    n_success: int | None
    instructions: tuple[str, ...]
    fields: dict[str, str]
    action: ActionStatistics
    image_size_px: tuple[int, int]


def summarize(dataset: OpenDataset) -> DatasetSummary:
    """Return what the card of a dataset says."""
    columns, numbers = dataset.columns, dataset.columns["episode_index"]
    success = columns[SUCCESS_KEY].astype(bool).reshape(-1) if SUCCESS_KEY in columns else None
    action = columns[ACTION_KEY].astype(np.float64)
    features = dataset.meta.features
    return DatasetSummary(
        dataset=dataset,
        lengths=tuple(dataset.lengths),
        n_success=None if success is None else len(np.unique(numbers[success])),
        instructions=tuple(sorted(str(task) for task in dataset.meta.tasks.index)),
        fields={name: _type(feature) for name, feature in sorted(features.items())},
        action=ActionStatistics(
            names=tuple(map(str, features[ACTION_KEY].get("names") or range(action.shape[1]))),
            mean=action.mean(axis=0),
            std=action.std(axis=0),
            low=action.min(axis=0),
            high=action.max(axis=0),
        ),
        image_size_px=tuple(features[next(iter(CAMERA_KEYS.values()))]["shape"][:2]),
    )


def draw_sheet(summary: DatasetSummary) -> bytes:
    """Return a PNG of the first, the middle and the last episode, one frame per phase."""
    n_episodes = len(summary.lengths)
    chosen = sorted({0, n_episodes // 2, n_episodes - 1})[:N_SHEET_EPISODES]
    dataset = summary.dataset
    frames = frame_source(dataset.local.whole, dataset.columns)
    frames = replace(frames, episodes=[frames.episodes[number] for number in chosen])
    cameras = list(CAMERA_KEYS.values())
    videos = zip(*(decode_camera(frames, camera) for camera in cameras), strict=True)
    rows = []
    labels: Sequence[str] = ()
    manifest = dataset.manifest
    for number, (base_TCHW, wrist_TCHW) in zip(chosen, videos, strict=True):
        moments = _moments(summary, number)
        labels = [*(f"base, {label}" for label, _ in moments), "wrist, last"]
        steps = [step for _, step in moments]
        pictures = [*base_TCHW[steps], wrist_TCHW[-1]]
        rows.append(
            SheetRow(
                name=f"episode {number}" + (f"\nseed {manifest[number].seed}" if manifest else ""),
                frames=tuple(np.ascontiguousarray(picture.transpose(1, 2, 0)) for picture in pictures),
            )
        )
    return contact_sheet(labels, rows)


def _moments(summary: DatasetSummary, number: int) -> list[tuple[str, int]]:
    """Return what to show of an episode, and at which frame; as many for every episode of a dataset."""
    last = summary.lengths[number] - 1
    episodes = summary.dataset.manifest
    if episodes and episodes[0].cue_steps:
        episode = episodes[number]
        choice = episode.cue_steps + episode.delay_steps
        moments = [("cue", 0), ("choice", choice), ("last", last)]
        if all(one.delay_steps for one in episodes):
            moments.insert(1, ("delay", episode.cue_steps))
    else:
        moments = [("first", 0), ("1/3", last // 3), ("2/3", 2 * last // 3), ("last", last)]
    return [(label, min(step, last)) for label, step in moments]


def _type(feature: Any) -> str:
    shape = " × ".join(str(size) for size in feature["shape"])
    return f"{feature['dtype']} ({shape})"
