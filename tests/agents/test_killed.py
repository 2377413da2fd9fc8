"""A training by rewards that is killed by SIGKILL is resumed by the same command, with the same weights."""

import itertools
import signal
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.test_resuming import files_of
from tests.agents.tiny_agents import TINY, tiny, trained
from tests.forked import run_forked
from vla_eval.config.files import to_data

STEP, WRITING = "in a step", "while a checkpoint is written"
# Of 48 steps, asked at each step of two environments; an imitation at each step, and while the expert acts.
# The first checkpoint is written at step 16, the second at 32.
N_ASKED = {"imitation": 22}
SCRIPT = """
import os, signal
from vla_eval.agents import checkpoints
from vla_eval.agents.train import train_agent
from vla_eval.config.agents import AgentConfig
from vla_eval.strict.decoding import decode

asked = []

def in_a_step():
    asked.append(None)
    if {moment!r} == "in a step" and len(asked) == {n_asked}:
        os.kill(os.getpid(), signal.SIGKILL)
    return False

def while_writing(folder):
    if {moment!r} != "in a step" and folder.name.endswith("32"):
        os.kill(os.getpid(), signal.SIGKILL)

checkpoints.sync_tree = while_writing
train_agent(decode(AgentConfig, {config!r}, where="test"), is_stopping=in_a_step)
"""


IN_EVERY_RUN = {*((algorithm, STEP) for algorithm in TINY), ("ppo", WRITING)}


@pytest.mark.parametrize(
    ("algorithm", "moment"),
    [
        pytest.param(*case, marks=() if case in IN_EVERY_RUN else pytest.mark.slow)
        for case in itertools.product(TINY, (STEP, WRITING))
    ],
)
def test_a_killed_training_is_resumed_with_the_weights_of_one_that_was_not(
    algorithm: str, moment: str, tmp_path: Path
) -> None:
    config = tiny(algorithm, tmp_path / "run")
    script = SCRIPT.format(moment=moment, config=to_data(config), n_asked=N_ASKED.get(algorithm, 13))
    done = run_forked(script, tmp_path)
    assert done.returncode == -signal.SIGKILL, done.stderr
    found = [folder.name for folder in (tmp_path / "run/train/checkpoints").glob("[0-9.]*")]
    assert sorted(found) == [".partial-000000032", "000000016"][moment != WRITING :]
    assert trained(config) == tmp_path / "run"
    assert files_of(tmp_path / "run") == files_of(trained(tiny(algorithm, tmp_path / "whole")))
