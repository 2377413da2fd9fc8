"""Training steps of recipes at random are measured on what the recipes train on."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.testing.script_files import load_script
from vla_eval.features import ACTION_KEY
from vla_eval.models.shared.earlier_frames import SEGMENT_PADDING_KEY

speed = load_script("training_speed")


@pytest.mark.slow
def test_a_step_with_memory_tokens_is_measured_on_sequences(no_network: None, tmp_path: Path) -> None:
    found = speed.measure_steps("pi05_memory_tokens", tmp_path / "step", device="cpu", n_steps=1, tiny=True)
    assert found["batch_size"] == 2 and found["step_seconds"] > 0
    assert not (tmp_path / "step").exists()


def test_a_sample_with_tokens_has_as_many_frames_as_the_longest_episode_needs() -> None:
    samples = {ACTION_KEY: torch.rand(2, 4, 8), "observation.state": torch.rand(2, 9), "task": ["a", "b"]}
    config = SimpleNamespace(memory_tokens=3, n_passes=lambda window_steps: (4, 8))
    sequences = speed.in_segments(samples, config)
    assert sequences[ACTION_KEY].shape == (2, 12, 4, 8) and sequences["observation.state"].shape == (2, 12, 9)
    assert sequences["task"] == ["a", "b"]
    assert sequences[SEGMENT_PADDING_KEY].shape == (2, 12) and not sequences[SEGMENT_PADDING_KEY].any()
    assert speed.in_segments(samples, SimpleNamespace(memory_tokens=0, n_passes=config.n_passes)) is samples
    assert speed.in_segments(samples, SimpleNamespace()) is samples
