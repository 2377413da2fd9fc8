"""A contact sheet of a dataset: a few episodes, one image per phase."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vla_eval.data.frames.frame_cache import decode_camera, frame_source
from vla_eval.data.opening import OpenDataset
from vla_eval.features import CAMERA_KEYS
from vla_eval.viz.contact_sheet import SheetRow, contact_sheet

N_SHEET_EPISODES = 3


def draw_sheet(dataset: OpenDataset) -> bytes:
    """Return a PNG of the first, the middle and the last episode, one frame per phase."""
    n_episodes = len(dataset.lengths)
    chosen = sorted({0, n_episodes // 2, n_episodes - 1})[:N_SHEET_EPISODES]
    frames = frame_source(dataset.local.whole, dataset.columns)
    frames = replace(frames, episodes=[frames.episodes[number] for number in chosen])
    cameras = list(CAMERA_KEYS.values())
    videos = zip(*(decode_camera(frames, camera) for camera in cameras), strict=True)
    rows = []
    labels: Sequence[str] = ()
    episodes = dataset.manifest
    for number, (base_TCHW, wrist_TCHW) in zip(chosen, videos, strict=True):
        # As many moments for every episode of a dataset.
        last = dataset.lengths[number] - 1
        if episodes and episodes[0].cue_steps:
            episode = episodes[number]
            choice = episode.cue_steps + episode.delay_steps
            moments = [("cue", 0), ("choice", choice), ("last", last)]
            if all(one.delay_steps for one in episodes):
                moments.insert(1, ("delay", episode.cue_steps))
        else:
            moments = [("first", 0), ("1/3", last // 3), ("2/3", 2 * last // 3), ("last", last)]
        moments = [(label, min(step, last)) for label, step in moments]
        labels = [*(f"base, {label}" for label, _ in moments), "wrist, last"]
        steps = [step for _, step in moments]
        pictures = [*base_TCHW[steps], wrist_TCHW[-1]]
        rows.append(
            SheetRow(
                name=f"episode {number}" + (f"\nseed {episodes[number].seed}" if episodes else ""),
                frames=tuple(np.ascontiguousarray(picture.transpose(1, 2, 0)) for picture in pictures),
            )
        )
    return contact_sheet(labels, rows)
