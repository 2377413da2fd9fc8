"""Simulators in several processes give what one gives, and say so when one of them ends."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.test_resuming import files_of
from tests.agents.tiny_agents import ROBOT, StopAfter, tiny, trained
from vla_eval.agents.simulators import Simulators, simulators
from vla_eval.agents.train import train_agent
from vla_eval.config.agents import AgentConfig
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import make_env
from vla_eval.errors import MissingDependencyError, SimulationError

pytestmark = pytest.mark.usefixtures("light_workers")


def settings(n_slots: int, **changes: Any) -> EnvSettings:
    return EnvSettings(task=ROBOT, simulator="fake", privileged=True, n_slots=n_slots, **changes)


@pytest.fixture
def spread(tmp_path: Path) -> Any:
    env = Simulators(settings(5), n_processes=2, logs=tmp_path / "logs")
    yield env
    env.close()


@pytest.mark.parametrize("render", [False, True])
def test_each_slot_gives_what_it_gives_in_one_process(spread: Simulators, render: bool) -> None:
    one = make_env(settings(5))
    assert spread.spec == one.spec
    seeds = {0: 7, 2: 9, 3: 9, 4: 1}
    mine, theirs = spread.reset(seeds, render=render), one.reset(seeds, render=render)
    rng = np.random.default_rng(0)
    for _ in range(3):
        assert mine.keys() == theirs.keys()
        for slot in mine:
            assert repr(mine[slot]) == repr(theirs[slot])
        slots = [2, 4]
        actions = {slot: rng.uniform(-1, 1, 7).astype(np.float32) for slot in slots}
        shown = frozenset({4} if render else ())
        mine, theirs = spread.step(actions, render=shown), one.step(actions, render=shown)
        np.testing.assert_array_equal(spread.hold_action(2), one.hold_action(2))


def test_a_training_in_several_processes_has_the_weights_of_one_in_this_process(tmp_path: Path) -> None:
    one = trained(tiny("ppo", tmp_path / "one", workers=1))
    two = trained(tiny("ppo", tmp_path / "two", workers=2))
    assert files_of(one) == files_of(two)


def test_a_robot_with_physics_is_simulated_in_another_process_also_by_one_worker(tmp_path: Path) -> None:
    """SAPIEN can abort where it ends; a training that is finished has to end with 0."""
    one = EnvSettings(task=ROBOT, n_slots=2)
    assert isinstance(simulators(one, workers=1, is_robot=True, logs=tmp_path), Simulators)
    base = EnvSettings(task="mikasa_base/MemoryLengthEasy-v0", n_slots=2)
    assert not isinstance(simulators(base, workers=1, is_robot=False, logs=tmp_path), Simulators)


def test_no_more_processes_than_slots_and_none_for_arrays_alone(tmp_path: Path) -> None:
    alone = simulators(settings(3), workers="auto", is_robot=True, logs=tmp_path)
    several = simulators(settings(3), workers=8, is_robot=True, logs=tmp_path)
    assert not isinstance(alone, Simulators) and isinstance(several, Simulators)
    assert len(several._processes) == 3


def on_gpu(out: Path) -> AgentConfig:
    asked = tiny("ppo", out)
    with_physics = {"sim_backend": "gpu", "simulator": "maniskill"}
    return replace(asked, train_agent={**asked.train_agent, **with_physics})


def test_on_a_gpu_one_process_holds_all_slots(tmp_path: Path) -> None:
    asked = EnvSettings(task=ROBOT, sim_backend="gpu", n_slots=8)
    for workers in ("auto", 4):
        found = simulators(asked, workers=workers, is_robot=True, logs=tmp_path)  # type: ignore[arg-type]
        assert isinstance(found, Simulators) and len(found._processes) == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")
def test_without_a_gpu_its_simulator_is_refused_before_there_is_a_folder(tmp_path: Path) -> None:
    physics = on_gpu(tmp_path / "run")
    with pytest.raises(
        MissingDependencyError, match=r"train_agent.sim_backend is 'gpu', but there are no GPUs"
    ):
        train_agent(physics)
    assert not (tmp_path / "run").exists()


@pytest.mark.gpu
def test_on_a_gpu_an_agent_is_trained_and_resumed(tmp_path: Path) -> None:
    physics = on_gpu(tmp_path / "run")
    assert not train_agent(physics, is_stopping=StopAfter(11)).is_finished
    assert train_agent(physics).is_finished


def test_a_process_that_ends_is_one_message_with_its_log(spread: Simulators) -> None:
    spread.reset({slot: slot for slot in range(5)}, render=False)
    process = spread._processes[1]._process
    assert process is not None and process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(SimulationError, match=r"simulator 1: its process ended .*simulator-1\.log"):
        for _ in range(100):
            spread.step({slot: spread_hold() for slot in range(5)}, render=frozenset())


def spread_hold() -> np.ndarray[Any, Any]:
    return np.zeros(7, np.float32)


def test_what_a_simulator_raises_is_raised_here_with_its_words(spread: Simulators) -> None:
    with pytest.raises(SimulationError, match=r"simulator 0: ValueError.*resumes the training"):
        spread.reset({0: -1, 4: 1}, render=False)
