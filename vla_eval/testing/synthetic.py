"""A synthetic dataset in our format, of random numbers: for tests, and to measure loaders."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vla_eval.core import ImageArray
from vla_eval.data.recording.shard_writer import new_dataset
from vla_eval.features import (
    CAMERA_KEYS,
    DONE_KEY,
    IMAGE_SHAPE,
    REWARD_KEY,
    STATE_NAMES,
    SUCCESS_KEY,
    EncoderSettings,
    StateKind,
    dataset_features,
)

INSTRUCTIONS = ("look, wait, choose", "follow the ball")


def write_synthetic_dataset(
    root: Path,
    *,
    n_episodes: int,
    n_frames: int,
    state: StateKind = "eef",
    seed: int = 0,
    instructions: Sequence[str] = INSTRUCTIONS,
) -> Path:
    """Write a `LeRobotDataset` of episodes of `n_frames` to `n_frames` + 2 frames; return `root`."""
    features = dataset_features(state)
    dataset = new_dataset(root, features, encoder=EncoderSettings(), max_frames=n_frames + 2)
    for episode in range(n_episodes):
        rng = np.random.default_rng([seed, episode])
        length = n_frames + episode % 3
        textures = {camera: _texture(rng) for camera in CAMERA_KEYS.values()}
        for step in range(length):
            dataset.add_frame(
                {
                    **{camera: np.roll(texture, 2 * step, axis=1) for camera, texture in textures.items()},
                    **_numbers(rng, features),
                    REWARD_KEY: rng.random(1, dtype=np.float32),
                    SUCCESS_KEY: np.array([step == length - 1]),
                    DONE_KEY: np.array([step == length - 1]),
                    "task": instructions[episode % len(instructions)],
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def _texture(rng: np.random.Generator) -> ImageArray:
    """Return an image of 8 × 8 px tiles with a little noise."""
    height, width, channels = IMAGE_SHAPE
    tiles = rng.integers(40, 216, (height // 8, width // 8, channels)).repeat(8, 0).repeat(8, 1)
    return (tiles + rng.integers(-8, 9, IMAGE_SHAPE)).astype(np.uint8)


def _numbers(rng: np.random.Generator, features: dict[str, Any]) -> dict[str, Any]:  # Any: arrays
    numbers = {
        key: rng.uniform(-1, 1, feature["shape"]).astype(np.float32)
        for key, feature in features.items()
        if feature["dtype"] == "float32" and key != REWARD_KEY
    }
    for key, values in numbers.items():
        if tuple(features[key]["names"]) == STATE_NAMES["joints"]:
            values[3:7] /= np.linalg.norm(values[3:7])
    return numbers
