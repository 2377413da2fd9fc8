"""Frames are those that this version drew when their digests were stored."""

import json
from typing import Any

import pytest

from tests.envs.stored_frames import STORED, frame_digest
from vla_eval.storage.provenance import mesa_version
from vla_eval.tasks.catalog import TASKS


def test_a_frame_of_each_task_is_equal_to_the_bit_to_that_with_the_whole_mesh(sampled_task: str) -> None:
    stored: dict[str, Any] = json.loads(STORED.read_text())
    if mesa_version() != stored["mesa"]:
        pytest.skip(f"the digests are of Mesa {stored['mesa']}, this machine has {mesa_version()}")
    device, digest = frame_digest(sampled_task, "shipped")
    if device != stored["render_device"]:
        pytest.skip(f"the digests are of {stored['render_device']}, this machine renders with {device}")
    assert digest == stored["frames"][sampled_task]


def test_every_task_has_a_stored_frame() -> None:
    assert sorted(json.loads(STORED.read_text())["frames"]) == sorted(TASKS)
