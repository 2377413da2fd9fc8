"""For all tests: nothing is looked for on the Hugging Face Hub; workers fork from one server."""

import os
import socket
from typing import Any

import pytest

# Read when huggingface_hub is imported.
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from vla_eval.workers.start import worker_context  # after the line above

# Whatever the first test of a process needs: what a server did not import, each worker would.
worker_context(
    preload=(
        "vla_eval.envs.maniskill",
        "vla_eval.evaluation.worker",
        "vla_eval.policies.lerobot",
        "vla_eval.data.recording_worker",
        "vla_eval.data.replay_worker",
    )
)


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse every connection but those of this machine's processes among themselves."""
    connect = socket.socket.connect

    def refuse(self: socket.socket, address: Any) -> None:
        if self.family != socket.AF_UNIX:
            raise AssertionError(f"a test tried to reach {address}")
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", refuse)
