"""Demonstrations of the stages on a real arm: a dataset below a namespace, and a sentence per colour."""

from pathlib import Path

import pytest

from vla_eval.cli.main import main
from vla_eval.data.manifest import read_manifest
from vla_eval.tasks.real_stages import COLORS
from vla_eval.tasks.real_twin import drawn

TASK = "real_twin/CubeVisible-v0"


@pytest.mark.slow
def test_each_episode_has_the_word_of_its_own_color(tmp_path: Path) -> None:
    recording = ["record", "--task", TASK, "--episodes", "4", "--workers", "1", "--out", str(tmp_path)]
    assert main([*recording, "--set", "env.robot=so100"]) == 0
    found = {episode.seed: episode.instruction for episode in read_manifest(tmp_path / TASK)}
    assert found == {seed: f"Pick the {COLORS[drawn(seed)[0]]} cube" for seed in found}
    assert len(set(found.values())) > 1
