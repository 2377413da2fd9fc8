"""A simulator under the lock: its import may start a program."""

import os
from types import SimpleNamespace
from typing import Any

import pytest

from vla_eval.config.environment import EnvSettings
from vla_eval.envs import factory
from vla_eval.envs.fake import FakeEnv
from vla_eval.lock.switch import locked


def test_a_locked_command_can_start_a_simulator_that_runs_a_program_when_it_is_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def imported(name: str) -> Any:
        assert os.system("true") == 0  # SAPIEN asks nvidia-smi; `bench` and `check-leak` import it themselves
        return SimpleNamespace(ManiSkillEnv=FakeEnv)

    monkeypatch.setattr(factory.importlib, "import_module", imported)
    with locked():
        factory.make_env(EnvSettings(task="RememberColor3-v0")).close()
