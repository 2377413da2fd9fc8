"""Entries of a manifest, from attempts of an expert."""

import dataclasses

from vla_eval.data.manifest import RecordedEpisode
from vla_eval.data.recording.demonstrations import Attempt

TASK = "RememberColor3-v0"


def entry_of(one: Attempt) -> RecordedEpisode:
    """Return what a recording would say of an attempt."""
    fields = {field.name: getattr(one, field.name) for field in dataclasses.fields(one)}
    return RecordedEpisode(
        episode_index=0,
        task=TASK,
        task_version=1,
        env_kwargs={},
        instruction="reach it",
        expert="oracle",
        expert_version=1,
        images_sha256={},
        **fields,
    )
