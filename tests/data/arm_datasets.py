"""Imitations of datasets that LeRobot's `lerobot-record` writes of an SO-101: its names, rates and sizes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vla_eval.data.recording.shard_writer import new_dataset
from vla_eval.features import EncoderSettings

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = tuple(f"{motor}.pos" for motor in MOTORS)
FPS, N_FRAMES = 30, 5
SENTENCES = ("Pick the red cube", "Pick the blue cube.")


def write_so101(
    root: Path,
    *,
    names: Sequence[str] = NAMES,
    action_names: Sequence[str] | None = None,
    sentences: Sequence[str] = SENTENCES,
    fps: int = FPS,
    seed: int = 0,
) -> Path:
    """Write one episode per sentence, without success, phases or records of ours."""
    sizes = {"observation.images.front": (48, 64, 3), "observation.images.wrist": (32, 64, 3)}
    vectors = {"observation.state": names, "action": names if action_names is None else action_names}
    features: dict[str, Any] = {
        **{
            key: {"dtype": "float32", "shape": (len(own),), "names": list(own)}
            for key, own in vectors.items()
        },
        **{
            key: {"dtype": "video", "shape": size, "names": ["height", "width", "channels"]}
            for key, size in sizes.items()
        },
    }
    dataset = new_dataset(
        root, features, encoder=EncoderSettings(), max_frames=N_FRAMES, robot="so101_follower", fps=fps
    )
    draws = np.random.default_rng(seed)
    for sentence in sentences:
        for _ in range(N_FRAMES):
            numbers = {
                key: draws.uniform(-90, 90, len(own)).astype(np.float32) for key, own in vectors.items()
            }
            images = {key: draws.integers(0, 256, size, dtype=np.uint8) for key, size in sizes.items()}
            dataset.add_frame({**numbers, **images, "task": sentence})
        dataset.save_episode()
    dataset.finalize()
    return root
