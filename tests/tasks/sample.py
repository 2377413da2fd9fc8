"""Which tasks the tests of all tasks run on."""

import pytest

from vla_eval.tasks.catalog import TASKS

SAMPLE = (
    "RememberColor9-v0",
    "ChainOfColors3-v0",
    "ShellGameTouch-v0",
    "ShellGamePick-v0",
    "InterceptMedium-v0",
    "RotateStrictPosNeg-v0",
    "TakeItBack-v0",
)
SAMPLED_TASKS = [
    pytest.param(task, marks=() if task in SAMPLE else pytest.mark.slow) for task in sorted(TASKS)
]
"""Each family in every run, the rest of the catalogue under the marker `slow`."""
